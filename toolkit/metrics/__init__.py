"""Image, trajectory and geometry measures."""
