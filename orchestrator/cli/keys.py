"""``muster keys``: access keys of the server."""

from __future__ import annotations

import time
from typing import Annotated

import typer
from rich.table import Table

from orchestrator.cli.jobs import JsonOption
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json, print_rows
from orchestrator.client import EXAMPLE_URL
from orchestrator.home import local_region, local_url, muster_home
from orchestrator.keys import KeyStore

NameArgument = Annotated[str, typer.Argument(help="Name of the key: its user or program.")]


def register(app: typer.Typer) -> None:
    group = make_group(
        "Manage the access keys of this home directory's server.\n\nAWS clients use a key as a key pair, muster as MUSTER_TOKEN.",
        "Example:  muster keys create alice --queue robots",
    )
    group.command(epilog="Example:  muster keys create alice --queue robots")(create)
    group.command("list", epilog="Example:  muster keys list --json | jq '.[].name'")(list_keys)
    group.command(epilog="Example:  muster keys delete alice")(delete)
    app.add_typer(group, name="keys")


def create(
    name: NameArgument,
    queue: Annotated[
        list[str] | None, typer.Option(help="A job queue that the key may use; repeatable. All queues by default.")
    ] = None,
    read_only: Annotated[bool, typer.Option("--read-only", help="The key may read but change nothing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Create a key and show it once. From now on the server admits only callers with a key or MUSTER_TOKEN."""
    key = KeyStore(muster_home()).create(name, tuple(queue or ()), read_only)
    if as_json:
        echo_json({**key.describe(), "secretAccessKey": key.secret})
        return
    url = local_url() or EXAMPLE_URL
    echo(
        f"""created key {key.name} ({key.rights}); its secret is shown only this once

AWS command, for `aws --profile {key.name} batch …` (boto3: boto3.Session(profile_name="{key.name}")):
  aws configure set aws_access_key_id {key.access_key_id} --profile {key.name}
  aws configure set aws_secret_access_key {key.secret} --profile {key.name}
  aws configure set region {local_region()} --profile {key.name}
  aws configure set endpoint_url {url} --profile {key.name}

muster, and 'Authorization: Bearer …' elsewhere:
  export MUSTER_TOKEN={key.access_key_id}:{key.secret}

The server of {muster_home()} demands a key from now on; it needs no restart."""
    )


def list_keys(as_json: JsonOption = False) -> None:
    """List the keys, without their secrets."""
    keys = KeyStore(muster_home()).load().values()
    if as_json:
        echo_json([key.describe() for key in keys], indent=1)
        return
    if not keys:
        echo("no keys yet; create one with: muster keys create NAME")
        return
    table = Table(box=None, pad_edge=False)
    for column in ("NAME", "ACCESS KEY ID", "MAY", "CREATED"):
        table.add_column(column, no_wrap=column != "MAY")
    for key in keys:
        created = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(key.created_at / 1000))
        table.add_row(key.name, key.access_key_id, key.rights, created)
    print_rows(table)


def delete(name: NameArgument) -> None:
    """Delete a key: a running server refuses its next request. After the last key, print who can still connect."""
    keys = KeyStore(muster_home())
    keys.delete(name)
    echo(f"deleted key {name}")
    if not keys.load():
        echo(
            f"""this was the last key of {muster_home()}:
  a running server admits only callers with its MUSTER_TOKEN, until a new key exists or it is restarted
  a server started from now on accepts its own user's requests on loopback without a key
  a server that other machines can reach (--host) does not start without a key or MUSTER_TOKEN"""
        )
