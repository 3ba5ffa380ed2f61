"""Where one stands, as plain maths: no window, no graphics device."""
