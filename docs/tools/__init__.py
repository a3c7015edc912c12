"""Pages of the documentation that are written from the code: ``python -m docs.tools`` writes them all."""
