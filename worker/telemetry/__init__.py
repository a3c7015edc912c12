"""Views of the worlds while they are simulated: the tap, recordings and pictures."""
