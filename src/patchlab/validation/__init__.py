"""Studies of the tool itself: whether what it states holds, and where it stops working."""
