"""Answers for foreign services, those of AWS that are not here (S3, STS, IAM, EC2, ECS …): each gets an error in its own form.

``AWS_ENDPOINT_URL`` sends every service to one address. A client that gets an answer of another protocol prints an error that helps
no one, so each gets one in its own: which service it has reached, and how to send only Batch and CloudWatch Logs here.
"""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Mapping
from urllib.parse import parse_qs
from xml.sax.saxutils import escape

from starlette.responses import JSONResponse, Response

OURS = ("batch", "logs")
"""Names of the services here, as requests are signed for them."""
_SCOPE = re.compile(r"(?:^|[\s=])[^\s/=]+/[0-9]{8}/[a-z0-9-]*/([a-z0-9-]{1,40})/aws4_request")
_CBOR, _FORM = "rpc-v2-cbor", "application/x-www-form-urlencoded"


def foreign_service(method: str, path: str, query: bytes, headers: Mapping[str, str]) -> str | None:
    """The service that a request is meant for, where that is not one of ours: as it is signed, else by its form.

    Args:
        method: Of the request.
        path: Of the request.
        query: The query string.
        headers: Names in lower case.
    """
    target = headers.get("x-amz-target", "")
    if (method == "POST" and path.startswith("/v1/")) or target.startswith("Logs_"):
        return None
    signed = headers.get("authorization", "")
    if b"X-Amz-Credential" in query:  # an address that was signed beforehand
        signed = f"={parse_qs(query.decode('latin-1')).get('X-Amz-Credential', [''])[0]}"
    if scope := _SCOPE.search(signed):
        return None if scope[1] in OURS else scope[1]
    if method == "POST" and path == "/":
        if target:
            return target.partition(".")[0][:40]
        if headers.get("content-type", "").startswith(_FORM):
            return "sts"  # its operations for callers without credentials are not signed
    return None


def refusal(service: str, headers: Mapping[str, str]) -> Response:
    """That the service is not here, in the form of its protocol."""
    name = re.sub(r"[^A-Za-z0-9_-]", "?", service)
    message = (
        f"this is Muster, which serves AWS Batch and CloudWatch Logs, not {name}: unset AWS_ENDPOINT_URL and set "
        "AWS_ENDPOINT_URL_BATCH and AWS_ENDPOINT_URL_CLOUDWATCH_LOGS instead"
    )
    kind, identifier = headers.get("content-type", ""), str(uuid.uuid4())
    common = {"x-amzn-requestid": identifier}
    if _CBOR in headers.get("smithy-protocol", ""):
        body = _cbor({"__type": "UnknownOperationException", "message": message})
        return Response(body, 400, {**common, "smithy-protocol": _CBOR}, "application/cbor")
    if kind.startswith("application/x-amz-json"):
        code = "UnknownOperationException"
        return JSONResponse({"__type": code, "message": message}, 400, {**common, "x-amzn-errortype": code}, kind)
    text = escape(message)
    if service == "ec2":
        error = f"<Errors><Error><Code>InvalidAction</Code><Message>{text}</Message></Error></Errors>"
        return _xml(f"<Response>{error}<RequestID>{identifier}</RequestID></Response>", 400, common)
    if service == "s3" or service.startswith("s3-"):
        error = f"<Code>NotImplemented</Code><Message>{text}</Message><RequestId>{identifier}</RequestId>"
        return _xml(f"<Error>{error}</Error>", 501, {**common, "x-amz-request-id": identifier})
    if kind.startswith(_FORM) or service in ("route53", "cloudfront"):
        error = f"<Error><Type>Sender</Type><Code>InvalidAction</Code><Message>{text}</Message></Error>"
        body_text = f"<ErrorResponse>{error}<RequestId>{identifier}</RequestId></ErrorResponse>"
        return _xml(body_text, 400, common)
    code = "UnknownOperationException"
    content = json.dumps({"__type": code, "message": message})
    return Response(content, 400, {**common, "x-amzn-errortype": code}, "application/json")


def _xml(body: str, status: int, headers: Mapping[str, str]) -> Response:
    return Response(f'<?xml version="1.0" encoding="UTF-8"?>\n{body}', status, dict(headers), "application/xml")


def _cbor(value: Mapping[str, str]) -> bytes:
    """A map of texts in CBOR (RFC 8949), of fewer than 24 entries."""

    def text(value: str) -> bytes:
        raw = value.encode()
        return b"\x79" + len(raw).to_bytes(2) + raw

    return bytes([0xA0 + len(value)]) + b"".join(text(key) + text(each) for key, each in value.items())
