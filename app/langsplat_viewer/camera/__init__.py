"""The camera as plain maths: no window, no graphics device."""
