"""``muster keys``: access keys of the server."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from orchestrator.cli.command_options import DatabaseOption, JsonOption
from orchestrator.cli.listings import Resource, date_ms
from orchestrator.cli.misuse import make_group
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import EXAMPLE_URL
from orchestrator.domain.errors import ServerError, Unavailable, UsageError
from orchestrator.home import ControllerRuns, HomeLock, muster_home, published
from orchestrator.persistence.access_keys import KeyStore
from orchestrator.persistence.home_files import move_in
from orchestrator.persistence.own_secrets import OwnSecrets
from orchestrator.persistence.session import Database, DatabaseTaken
from orchestrator.persistence.urls import database_url, shown

NameArgument = Annotated[str, typer.Argument(help="Name of the key: its user or program.")]
KEYS = Resource(
    {
        "NAME": lambda key: key.name,
        "ACCESS KEY ID": lambda key: key.access_key_id,
        "MAY": lambda key: key.rights,
        "SHARE": lambda key: key.share,
        "CREATED": lambda key: date_ms(key.created_at),
    },
    "no keys yet; create one with: muster keys create NAME",
    whole=True,
)


def register(app: typer.Typer) -> None:
    group = make_group(
        "Manage the access keys of this home directory's server.\n\nAWS clients use a key as a key pair, muster as MUSTER_TOKEN.",
        "Example:  muster keys create alice --queue robots",
        list_keys,
    )
    group.command(epilog="Example:  muster keys create alice --queue robots")(create)
    group.command("list", epilog="Example:  muster keys list --json | jq '.[].name'")(list_keys)
    group.command(epilog="Example:  muster keys delete alice")(delete)
    app.add_typer(group, name="keys")


def create(
    name: NameArgument,
    queue: Annotated[
        list[str] | None,
        typer.Option("--queue", metavar="QUEUE", help="A job queue that the key may use; repeatable. Default: all."),
    ] = None,
    read_only: Annotated[bool, typer.Option("--read-only", help="The key may read but change nothing.")] = False,
    share: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Share identifier of its jobs in queues with a fair-share policy; several keys may have one. By default the letters and "
            "digits of its name.",
        ),
    ] = None,
    database: DatabaseOption = None,
    as_json: JsonOption = False,
) -> None:
    """Create a key and show it once.

    From the first key on everybody needs a token: also the controller's own user, and also on the Unix socket.
    """
    with opened(muster_home(), database) as keys:
        is_first = keys.is_empty
        key = keys.create(name, queue, read_only, share)
    if as_json:
        echo_json({**key.describe(), "secretAccessKey": key.secret})
        return
    running = published(muster_home())
    url, region = (running.url, running.region) if running else (EXAMPLE_URL, "us-east-1")
    if is_first:
        echo(
            "from now on everybody needs a token for this controller: also its own user, and also on the Unix socket\n"
        )
    echo(
        f"""created key {key.name} ({key.rights}, share {key.share}); its secret is shown only this once

AWS command, for `aws --profile {key.name} batch …` (boto3: boto3.Session(profile_name="{key.name}")):
  aws configure set aws_access_key_id {key.access_key_id} --profile {key.name}
  aws configure set aws_secret_access_key {key.secret} --profile {key.name}
  aws configure set region {region} --profile {key.name}
  aws configure set endpoint_url {url} --profile {key.name}

muster, and 'Authorization: Bearer …' elsewhere:
  export MUSTER_TOKEN={key.access_key_id}:{key.secret}

A running controller accepts the key within a second."""
    )


def list_keys(database: DatabaseOption = None, as_json: JsonOption = False) -> None:
    """List the keys, without their secrets."""
    with opened(muster_home(), database) as store:
        keys = [*store.current().values()]
    if as_json:
        echo_json([key.describe() for key in keys], indent=1)
    else:
        KEYS.show(keys)


def delete(name: NameArgument, database: DatabaseOption = None, as_json: JsonOption = False) -> None:
    """Delete a key: a running server refuses it within a second. After the last key, print who can still connect."""
    with opened(muster_home(), database) as keys:
        keys.delete(name)
        left = keys.current()
    if as_json:
        echo_json({"name": name, "keys": len(left)})
        return
    echo(f"deleted key {name}")
    if not left:
        echo(
            f"""this was the last key of {muster_home()}:
  a running server admits only callers with its MUSTER_TOKEN, until a new key exists or it is restarted
  a server started from now on accepts its own user's requests on loopback without a key
  a server that other machines can reach (--host) does not start without a key or MUSTER_TOKEN"""
        )


@contextlib.contextmanager
def opened(home: Path, database: str | None = None) -> Iterator[KeyStore]:
    """The keys of a home directory's database, whether a controller runs on it or not.

    Where none does, this is the first start: the database and the sealing key are made, and the files of an older Muster moved in. The lock
    makes a controller that starts meanwhile wait.

    Raises ServerError.
    """
    with contextlib.ExitStack() as stack:
        try:
            try:
                stack.callback(HomeLock(home, temporary=True).release)
                found = Database.at(home, database)
            except (ControllerRuns, DatabaseTaken):
                _check_same(home, database)
                found = Database.at(home, database, beside=True)
            stack.callback(found.close)
            own = OwnSecrets(found, home)
            keys = KeyStore(own)
            move_in(home, own, keys)
            yield keys
        except (Unavailable, ArgumentError) as error:
            raise ServerError(str(error)) from None
        except OSError as error:
            raise ServerError(
                f"{home}: can't be used ({error.strerror}); set MUSTER_HOME to a directory that can be written"
            ) from None


def _check_same(home: Path, database: str | None) -> None:
    """Raises UsageError where the controller that runs on this home directory has another database."""
    running = published(home)
    if running is not None and running.database != shown(str(make_url(database_url(home, database)))):
        raise UsageError(
            f"the controller of {home} has its keys in {running.database}: set --database or MUSTER_DATABASE to that"
        )
