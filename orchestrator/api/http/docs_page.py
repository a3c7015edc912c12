"""The API's description as one page of HTML: written here from the OpenAPI document, without scripts and without other origins.

A page with scripts would run in an origin that may submit jobs; this one only has to be read.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
@media (prefers-color-scheme: dark) { body { background: #16181d; color: #e4e6eb; } a { color: #8ab4f8; } }
h2 { font: 600 1rem/1.5 ui-monospace, monospace; margin: 2.5rem 0 0.5rem; overflow-wrap: anywhere; }
table { border-collapse: collapse; } td, th { padding: 0.2rem 1rem 0.2rem 0; text-align: left; vertical-align: top; }
pre { white-space: pre-wrap; }
"""

POLICY = (
    f"default-src 'none'; style-src 'sha256-{base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()}'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The page's Content-Security-Policy: its own style, and nothing else."""


def render(document: Mapping[str, Any], source: str) -> str:
    """The page of an OpenAPI document, which is at ``source``."""
    title = escape(f"{document['info']['title']} {document['info']['version']}")
    operations = [
        _operation(method.upper(), path, operation, document)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style></head><body>'
        f'<h1>{title}</h1><p>The native API, as an <a href="{escape(source)}">OpenAPI document</a> has it for programs. AWS Batch is '
        "at <code>POST /v1/&lt;operation&gt;</code> and CloudWatch Logs at <code>POST /</code>, as AWS documents them.</p>"
        f"{''.join(operations)}</body></html>"
    )


def _operation(method: str, path: str, operation: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    paragraphs = str(operation.get("description", "")).split("\n\n")
    text = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs if paragraph)
    rows = "".join(
        f"<tr><td><code>{escape(name)}</code></td><td>{escape(kind)}</td><td>{escape(where)}</td></tr>"
        for name, kind, where in _inputs(operation, document)
    )
    table = f"<table><tr><th>Name</th><th>Type</th><th>In</th></tr>{rows}</table>" if rows else ""
    return f"<section><h2>{escape(method)} {escape(path)}</h2>{text}{table}</section>"


def _inputs(operation: Mapping[str, Any], document: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Name, type and place of each parameter and each member of the body."""
    for parameter in operation.get("parameters", []):
        yield parameter["name"], _kind(parameter["schema"]), _place(parameter["in"], parameter.get("required", False))
    content = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    body = _resolved(content.get("schema", {}), document)
    for name, schema in body.get("properties", {}).items():
        yield name, _kind(schema), _place("body", name in body.get("required", []))


def _place(where: str, required: bool) -> str:
    return f"{where}, required" if required else where


def _kind(schema: Mapping[str, Any]) -> str:
    kinds = [str(each.get("type", "any")) for each in schema.get("anyOf", [schema])]
    default = schema.get("default")
    return " or ".join(kinds) + ("" if default is None else f", by default {json.dumps(default)}")


def _resolved(schema: Mapping[str, Any], document: Mapping[str, Any]) -> Mapping[str, Any]:
    """The schema that a reference into the document's components names; any other as it is."""
    name = str(schema.get("$ref", "")).rpartition("/")[2]
    found: Mapping[str, Any] = document["components"]["schemas"][name] if name else schema
    return found
