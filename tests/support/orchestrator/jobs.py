"""Jobs as a client sees them."""

from __future__ import annotations

from typing import Any

from orchestrator.client import Client
from tests.support.waiting import wait_for

FOREVER = "import time; time.sleep(600)"


def detail(client: Client, job_id: str) -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"/api/jobs/{job_id}")
    return found


def await_status(client: Client, job_id: str, *wanted: str) -> dict[str, Any]:
    def there() -> dict[str, Any] | None:
        found = detail(client, job_id)
        return found if found["status"] in wanted else None

    found: dict[str, Any] = wait_for(there, 30, f"job {job_id} {wanted}")
    return found
