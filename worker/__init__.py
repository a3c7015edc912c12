"""The data plane: what runs inside a node. Never imports ``orchestrator``."""
