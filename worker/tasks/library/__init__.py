"""The library: the tasks and robots that come with Muster."""
