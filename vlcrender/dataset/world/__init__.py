"""True cameras, LEDs and instruments behind the told ones, their views, and the bounds of both."""
