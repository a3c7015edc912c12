"""The racer in the store: tracks, leagues with their entries, and the rules of races; imports no torch."""
