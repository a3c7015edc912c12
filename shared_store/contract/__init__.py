"""The contracts between a controller, its nodes and their policies, and the messages that they exchange."""

from shared_store.contract.node import sealed as sealed  # engines of others import it from here
