"""Real robots that tasks share: files of other packages, with gains, poses and collisions as those packages set them."""
