"""Speed against accuracy of every knob."""
