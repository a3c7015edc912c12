"""An older commit of Muster beside today's: its code in an environment, and a home that it left behind."""
