"""The API's description as one page of HTML: made from the OpenAPI document, without scripts and without other origins.

A page with scripts would run in an origin that may submit jobs; this one only has to be read.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from jinja2 import Environment

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
@media (prefers-color-scheme: dark) { body { background: #16181d; color: #e4e6eb; } a { color: #8ab4f8; } }
h2 { font: 600 1rem/1.5 ui-monospace, monospace; margin: 2.5rem 0 0.5rem; overflow-wrap: anywhere; }
table { border-collapse: collapse; } td, th { padding: 0.2rem 1rem 0.2rem 0; text-align: left; vertical-align: top; }
pre { white-space: pre-wrap; }
"""
_PAGE = Environment(autoescape=True, trim_blocks=True).from_string("""\
<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title><style>{{ style|safe }}</style></head><body>
<h1>{{ title }}</h1><p>The native API, as an <a href="{{ source }}">OpenAPI document</a> has it for programs. AWS Batch is at
<code>POST /v1/&lt;operation&gt;</code> and CloudWatch Logs at <code>POST /</code>, as AWS documents them.</p>
{% for path, methods in document.paths.items() %}{% for method, operation in methods.items() %}
<section><h2>{{ method|upper }} {{ path }}</h2>
{% for paragraph in operation.get("description", "").split("\n\n") if paragraph %}<p>{{ paragraph }}</p>{% endfor %}
{% for name, kind, place in inputs(operation) %}
{{ "<table><tr><th>Name</th><th>Type</th><th>In</th></tr>"|safe if loop.first }}
<tr><td><code>{{ name }}</code></td><td>{{ kind }}</td><td>{{ place }}</td></tr>
{{ "</table>"|safe if loop.last }}
{% endfor %}</section>
{% endfor %}{% endfor %}</body></html>
""")

POLICY = (
    f"default-src 'none'; style-src 'sha256-{base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()}'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The page's Content-Security-Policy: its own style, and nothing else."""


def render(document: Mapping[str, Any], source: str) -> str:
    """The page of an OpenAPI document, which is at ``source``."""

    def inputs(operation: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
        """Name, type and place of each parameter and each member of the body."""
        for each in operation.get("parameters", []):
            yield each["name"], _kind(each["schema"]), _place(each["in"], each.get("required", False))
        body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
        if reference := body.get("$ref"):
            body = document["components"]["schemas"][reference.rpartition("/")[2]]
        for name, schema in body.get("properties", {}).items():
            yield name, _kind(schema), _place("body", name in body.get("required", []))

    title = f"{document['info']['title']} {document['info']['version']}"
    return _PAGE.render(document=document, source=source, title=title, style=_STYLE, inputs=inputs)


def _place(where: str, required: bool) -> str:
    return f"{where}, required" if required else where


def _kind(schema: Mapping[str, Any]) -> str:
    kinds = [str(each.get("type", "any")) for each in schema.get("anyOf", [schema])]
    default = schema.get("default")
    return " or ".join(kinds) + ("" if default is None else f", by default {json.dumps(default)}")
