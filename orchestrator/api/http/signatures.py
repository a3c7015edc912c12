"""AWS Signature Version 4, verified: botocore's signer signs the request again, and the two signatures must be the same."""

from __future__ import annotations

import hmac
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any

from botocore.auth import SigV4Auth
from botocore.awsrequest import AWSRequest
from botocore.credentials import Credentials

from orchestrator.api.http.foreign_services import OURS
from orchestrator.api.http.request_head import RequestHead
from orchestrator.services.permissions import Refusal

ALGORITHM = "AWS4-HMAC-SHA256"
SKEW = 15 * 60
"""Seconds that a signature's time may differ from the server's."""


class _Signer(SigV4Auth):  # type: ignore[misc]
    """Signs the headers that the client has signed; by itself it would leave out some, and add others."""

    def headers_to_sign(self, request: Any) -> Any:
        return request.headers


@dataclass(frozen=True)
class Signed:
    """An Authorization header: which key, at what time, signed which headers."""

    access_key_id: str
    date: str
    region: str
    service: str
    signed: tuple[str, ...]
    signature: str

    @classmethod
    def parse(cls, credentials: str) -> Signed:
        """The fields after the algorithm's name in the header. Raises Refusal."""
        parts = {name: value for name, _, value in (part.strip().partition("=") for part in credentials.split(","))}
        for name in ("Credential", "SignedHeaders", "Signature"):
            if not parts.get(name):
                raise Refusal("IncompleteSignature", f"Authorization header requires {name!r} parameter")
        access_key_id, date, region, service, end = [*parts["Credential"].split("/", 4), *[""] * 4][:5]
        if end != "aws4_request" or service not in OURS:
            raise Refusal(
                "IncompleteSignature",
                f"Credential {parts['Credential'][:160]!r}: expected KEY/DATE/REGION/SERVICE/aws4_request with service "
                f"{' or '.join(OURS)}",
            )
        signed = tuple(parts["SignedHeaders"].split(";"))
        if list(signed) != sorted({name.lower() for name in signed}):
            raise Refusal(
                "IncompleteSignature",
                f"SignedHeaders {parts['SignedHeaders'][:160]!r}: expected lower-case names, sorted, each once",
            )
        return cls(access_key_id, date, region, service, signed, parts["Signature"])

    def check(self, head: RequestHead, now: datetime) -> None:
        """Check what needs no secret: all required headers are signed, and the time is current. Raises Refusal."""
        for name in ("host", *(name for name in head.headers if name.startswith("x-amz-"))):
            if name not in self.signed:
                raise Refusal(
                    "InvalidSignatureException", f"header {name} is not signed; sign host and every x-amz-* header"
                )
        for name in self.signed:
            if name not in head.headers:
                raise Refusal("InvalidSignatureException", f"header {name[:80]!r} is signed but was not sent")
        time = head.single("x-amz-date") or ""
        try:
            if not re.fullmatch(r"[0-9]{8}T[0-9]{6}Z", time):
                raise ValueError
            skew = (datetime.strptime(time, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC) - now).total_seconds()
        except ValueError:
            raise Refusal(
                "IncompleteSignature",
                f"header x-amz-date is {time[:80]!r}; it must be the time of signing, such as 20260131T235959Z",
            ) from None
        if abs(skew) > SKEW:
            raise Refusal(
                "RequestExpired",
                f"Signature expired: the request was signed at {time} and the server's clock says {now:%Y%m%dT%H%M%SZ}; "
                f"they may differ by {SKEW // 60} minutes, so set the client's clock",
            )
        if time[:8] != self.date:
            raise Refusal(
                "InvalidSignatureException", f"the credential is scoped to {self.date!r}, not to the day of {time}"
            )

    def check_signature(self, head: RequestHead, body: bytes, secret: str) -> None:
        """Sign the request again with the secret of its key, and compare. Raises Refusal."""
        digest = head.single("x-amz-content-sha256")
        if digest is not None and digest.lower() != sha256(body).hexdigest():
            raise Refusal(
                "InvalidSignatureException",
                f"x-amz-content-sha256 is {digest[:80]!r}, which is not the SHA-256 of the body; the body must be signed",
            )
        # no "#" begins a fragment, which would not be signed; botocore drops the slash in front of the path
        target = b"?".join([head.raw_path, head.query]).replace(b"#", b"%23").decode("latin-1")
        request = AWSRequest(head.method, f"http://localhost/{target}", data=body)
        for name in self.signed:
            for value in head.headers.getlist(name):
                request.headers[name] = _text(value)  # adds: a header may be sent twice
        request.context["timestamp"] = request.headers["x-amz-date"]
        signer = _Signer(Credentials(self.access_key_id, secret), self.service, self.region)
        again = signer.signature(signer.string_to_sign(request, signer.canonical_request(request)), request)
        if not hmac.compare_digest(again.encode(), self.signature.encode()):
            raise Refusal(
                "InvalidSignatureException",
                "The request signature we calculated does not match the signature you provided. Check your AWS Secret Access "
                f"Key and signing method (key {self.access_key_id})",
            )


def _text(value: str) -> str:
    """A header's value, which was decoded as Latin-1; botocore signs it in UTF-8, in which most clients send it."""
    try:
        return value.encode("latin-1").decode()
    except UnicodeDecodeError:
        return value
