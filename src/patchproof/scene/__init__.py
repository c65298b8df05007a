"""What is photographed: the object, where the piece sits on it, and the conditions it is seen under."""
