"""Identifiers of access keys and shares, as regular expressions without anchors."""

from __future__ import annotations

ACCESS_KEY_ID = "[A-Z0-9]{16,128}"
"""Of an access key; a caller sends it in front of the secret or in a signature."""
SHARE = "[A-Za-z0-9]{1,255}"
"""AWS's share identifier."""
