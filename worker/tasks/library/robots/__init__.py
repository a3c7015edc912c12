"""Real robots shared by tasks: files of other packages, with the gains, poses and collisions of those packages."""
