"""The console: web pages on the orchestrator's own port, for people who prefer pages to commands.

Pages are rendered here with Jinja2; small modules of JavaScript keep them live over server-sent events. A page calls the functions that
the API calls (:mod:`orchestrator.api.native`, :mod:`orchestrator.api.batch`), so that it can do nothing that the API can't, and these
functions decide what the caller may see and do.

How to add a page
-----------------
1. **A module** ``console/things.py`` with a router; add its name to :data:`PAGES` below::

       router = page_router()

       @router.get("/things")
       def things(request: Request, search: str = "") -> Response:
           found = page_of_things(controller_of(request), search)        # a use case of the API; it raises ClientError
           return render(request, "things.html", things=found)

   ``page_router`` (:mod:`orchestrator.console.routing`) turns errors into pages (or JSON for a script), and refuses changes without the
   form's token and addresses with a parameter twice. Plain ``def`` functions run in a thread, where the database may be used.
2. **A template** ``templates/things.html`` that extends ``base.html``: blocks ``title``, ``content``, ``scripts``; it formats what the API
   gives with the macros of ``parts.html`` and the filters of :mod:`orchestrator.console.formats`. Its navigation entry is a line of
   :data:`orchestrator.console.pages.NAVIGATION`. Everything is escaped; never use ``|safe``. No ``style=`` and no ``on…=``: the
   Content-Security-Policy forbids them.
3. **An action**: ``@router.post("/things/{name}/remove")`` with ``form: Form = Depends(sent_form)``. Where something is lost, begin with
   ``form.confirm(Question(…))``; end with ``done(request, "/things", "removed x")``. In the template: the macro ``action``, where
   ``may_change``.
4. **Live parts**: macros of ``templates/things_live.html``, which the page imports. A table is written by the macro ``live_table``, another
   part stands in an element whose id is the macro's name. ``@router.get("/things/stream")`` returns
   :func:`orchestrator.console.live.stream` of ``LiveParts(request, "things_live.html").changes``, which renders the same macros again for
   what changed. An element with ``data-live="/things/stream"`` needs no script of its own. A page has one stream, since browsers open only
   six connections to a server.
5. **Styles**: classes of ``static/console.css`` first; one file a page only where it needs many of its own.
6. **A test** ``tests/integration/console/test_things.py``: the page by HTTP (``console`` fixture: a client with a session and
   ``submit(path, **fields)``), with hostile names, and as a read-only key; the way by clicking is in the browser's tests.
"""

from __future__ import annotations

from importlib import import_module

from fastapi import FastAPI

from orchestrator.console import assets, routing, submit_fields

PAGES = (
    "login",
    "jobs",
    "job",
    "job_log",
    "job_actions",
    "job_view",
    "run_files",
    "curves",
    "queues",
    "runs",
    "compare",
    "keys",
    "submit",
    "models",
)
"""Modules of this package, each with a ``router``."""


def add_console(app: FastAPI) -> None:
    """Add the pages to the application that :func:`orchestrator.api.http.app.create_app` made.

    Raises PluginError: a plug-in's part of the wizard can't be used.
    """
    submit_fields.forms()
    app.include_router(assets.router)
    for name in PAGES:
        app.include_router(import_module(f"{__name__}.{name}").router)
    routing.finish(app)
