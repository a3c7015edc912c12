"""Signature Version 4, checked against botocore's own signer: over requests of every form, and over what is changed after signing."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from urllib.parse import unquote, urlsplit

import pytest
from botocore.auth import SigV4Auth, SigV4QueryAuth
from botocore.awsrequest import AWSRequest
from botocore.credentials import Credentials
from hypothesis import example, given, settings
from hypothesis import strategies as st
from starlette.types import Message, Receive, Scope, Send

from orchestrator.api.http.access import Access
from orchestrator.api.http.auth import Guard
from orchestrator.api.http.limits import RateLimit
from orchestrator.persistence.access_keys import Key, KeyStore
from tests.support.keys import key_store

HOST = "controller.example:7777"
LETTERS = "abcxyzABCXYZ0189"
PATH = LETTERS + "-._~!$&'()*+,;=:@%/"
VALUE = "".join(map(chr, range(0x20, 0x7F))) + "\t"
ACCEPTED = "accepted"
REFUSALS = {
    *("IncompleteSignature", "InvalidSignatureException", "MissingAuthenticationToken", "RequestExpired"),
    "UnrecognizedClientException",
}


@dataclass(frozen=True)
class Sent:
    """A request on the wire. Its headers have lower-case names, as uvicorn hands them on."""

    method: str
    path: str
    query: str
    headers: tuple[tuple[str, str], ...]
    body: bytes

    def to_sign(self) -> AWSRequest:
        request = AWSRequest(self.method, f"https://{HOST}{self.path}?{self.query}", data=self.body)
        for name, value in self.headers:
            request.headers[name] = value  # adds: a header may come twice
        return request


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> KeyStore:
    store = key_store(tmp_path_factory.mktemp("home"))
    store.create("admin")
    return store


@pytest.fixture(scope="module")
def key(store: KeyStore) -> Key:
    return next(iter(store.current().values()))


def signer_of(key: Key, service: str, region: str) -> SigV4Auth:
    return SigV4Auth(Credentials(key.access_key_id, key.secret), service, region)


def signed(sent: Sent, signer: SigV4Auth) -> Sent:
    """``sent`` with the headers that botocore adds, and the host, which the HTTP client adds."""
    request = sent.to_sign()
    signer.add_auth(request)
    headers = tuple((name.lower(), value) for name, value in request.headers.items())
    return replace(sent, headers=(("host", HOST), *headers))


def signature_of(sent: Sent, signer: SigV4Auth, timestamp: str) -> str:
    """The signature that botocore would give to what has come."""
    request = replace(sent, headers=tuple(each for each in sent.headers if each[0] != "authorization")).to_sign()
    request.context["timestamp"] = timestamp
    return str(signer.signature(signer.string_to_sign(request, signer.canonical_request(request)), request))


def header(sent: Sent, name: str) -> str:
    return dict(sent.headers)[name]


def answer_to(sent: Sent, store: KeyStore) -> str:
    """``ACCEPTED`` where the application sees the request with its body, else the name of the error."""
    seen: list[bytes] = []
    reported: list[str] = []

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        seen.append((await receive())["body"])

    async def receive() -> Message:
        return {"type": "http.request", "body": sent.body, "more_body": False}

    async def send(message: Message) -> None:
        reported.extend(value.decode() for name, value in message.get("headers", ()) if name == b"x-amzn-errortype")

    scope = {
        "type": "http",
        "method": sent.method,
        "path": unquote(sent.path),
        "raw_path": sent.path.encode(),
        "query_string": sent.query.encode(),
        "headers": [(name.encode(), value.encode("latin-1")) for name, value in sent.headers],
        "client": ("192.0.2.1", 40000),
    }
    guard = Guard(application, Access(store), RateLimit(0))  # a new one each time: no failure is one too many
    asyncio.run(guard(scope, receive, send))
    if reported:
        assert not seen
        return reported[0]
    assert seen == [sent.body]
    return ACCEPTED


def edits(alphabet: str) -> st.SearchStrategy[Callable[[str, int], str]]:
    """Changes of one character behind the first ``kept``: replaced, inserted or left out."""
    choice = st.tuples(
        st.sampled_from(["replace", "insert", "delete"]), st.integers(0, 10_000), st.sampled_from(alphabet)
    )

    def edit(drawn: tuple[str, int, str]) -> Callable[[str, int], str]:
        kind, number, character = drawn

        def apply(text: str, kept: int = 0) -> str:
            room = len(text) - kept
            if kind == "insert" or not room:
                place = kept + number % (room + 1)
                return text[:place] + character + text[place:]
            place = kept + number % room
            return text[:place] + (character if kind == "replace" else "") + text[place + 1 :]

        return apply

    return choice.map(edit)


segments = st.one_of(st.sampled_from(["", ".", "..", "%2F", "%2e%2E", "arn%3Aaws%3Abatch", "~a b".replace(" ", "%20")]),
                     st.text(PATH.replace("/", ""), max_size=8))  # fmt: skip
paths = st.lists(segments, max_size=5).map(lambda parts: "/" + "/".join(parts))
queries = st.one_of(
    st.just(""),
    st.lists(st.tuples(st.text(LETTERS + "-._~%+:/", max_size=4), st.sampled_from(["=", ""]), st.text(PATH, max_size=6)), max_size=4)
    .map(lambda pairs: "&".join(name + sign + value for name, sign, value in pairs)),
)  # fmt: skip
names = st.one_of(
    st.sampled_from(["content-type", "accept", "user-agent", "x-amz-meta-tag", "amz-sdk-request", "x-amzn-trace-id"]),
    st.text("abc-", min_size=1, max_size=3).map(lambda text: f"x-{text}"),
)
headers = st.lists(st.tuples(names, st.text(VALUE, max_size=12)), max_size=4)
places = st.tuples(st.sampled_from(["batch", "logs"]), st.sampled_from(["us-east-1", "eu-central-1"]))


@st.composite
def requests(draw: st.DrawFn) -> Sent:
    method, body = draw(st.sampled_from(["GET", "POST", "PUT", "DELETE"])), draw(st.binary(max_size=40))
    supplied_headers = draw(headers)
    if draw(st.booleans()):
        supplied_headers.append(("x-amz-content-sha256", sha256(body).hexdigest()))
    return Sent(method, draw(paths), draw(queries), tuple(supplied_headers), body)


@settings(max_examples=200)
@given(requests(), places)
@example(Sent("POST", "/v1/submitjob", "", (("content-type", "application/json"),), b"{}"), ("batch", "us-east-1"))
@example(
    Sent("GET", "/a/./b//../c/", "b=2&a=%20&b=1&flag&=", (("x-a", " 1  2\t3 "), ("x-a", "4")), b""),
    ("logs", "us-east-1"),
)
def test_signatures_of_botocore_are_accepted(store: KeyStore, key: Key, sent: Sent, place: tuple[str, str]) -> None:
    assert answer_to(signed(sent, signer_of(key, *place)), store) == ACCEPTED


@settings(max_examples=500)
@given(
    requests(), places, st.sampled_from(["method", "path", "query", "body", "header"]), st.integers(0, 100), st.data()
)
def test_a_request_changed_after_signing_is_accepted_only_where_botocore_would_sign_it_alike(
    store: KeyStore, key: Key, sent: Sent, place: tuple[str, str], part: str, number: int, data: st.DataObject
) -> None:
    signer = signer_of(key, *place)
    before = signed(sent, signer)
    if part == "method":
        after = replace(before, method=data.draw(st.sampled_from(["GET", "POST", "PUT", "PATCH", "DELETE"])))
    elif part == "path":
        after = replace(before, path=data.draw(edits(PATH))(before.path, 1))
    elif part == "query":
        after = replace(before, query=data.draw(edits(PATH + "&"))(before.query, 0))
    elif part == "body":
        edited = data.draw(edits("".join(map(chr, range(256)))))(before.body.decode("latin-1"), 0)
        after = replace(before, body=edited.encode("latin-1"))
    else:
        listed = [index for index, (name, _) in enumerate(before.headers) if name not in ("authorization", "host")]
        index = listed[number % len(listed)]
        name, value = before.headers[index]
        edited = data.draw(edits(VALUE))(value, 0).strip(" \t")  # as every HTTP server does
        after = replace(before, headers=(*before.headers[:index], (name, edited), *before.headers[index + 1 :]))
    timestamp = header(before, "x-amz-date")
    same = header(before, "authorization").endswith(f"Signature={signature_of(after, signer, timestamp)}")
    digest = dict(after.headers).get("x-amz-content-sha256")  # the signer believes it; the server must not
    if same and (digest is None or digest == sha256(after.body).hexdigest()):
        assert answer_to(after, store) == ACCEPTED
    else:
        assert answer_to(after, store) in REFUSALS


@settings(max_examples=200)
@given(requests(), places, st.integers(0, 10_000), st.sampled_from("0123456789abcdefghijklmnopqrstuvwxyz"))
def test_no_character_of_the_authorization_can_be_another(
    store: KeyStore, key: Key, sent: Sent, place: tuple[str, str], number: int, character: str
) -> None:
    before = signed(sent, signer_of(key, *place))
    given = header(before, "authorization")
    at = number % len(given)
    if given[at].lower() == character:  # upper and lower case mean the same in names of headers
        character = "-"
    changed = given[:at] + character + given[at + 1 :]
    others = tuple(each for each in before.headers if each[0] != "authorization")
    answer = answer_to(replace(before, headers=(*others, ("authorization", changed))), store)
    # a credential for another service is answered in that service's own words
    assert answer in REFUSALS | {"UnknownOperationException"}


@settings(max_examples=100)
@given(requests(), places, st.integers(0, 100), st.booleans())
def test_a_signed_header_can_be_neither_left_out_nor_renamed(
    store: KeyStore, key: Key, sent: Sent, place: tuple[str, str], number: int, renamed: bool
) -> None:
    before = signed(sent, signer_of(key, *place))
    names = header(before, "authorization").partition("SignedHeaders=")[2].partition(",")[0].split(";")
    name = names[number % len(names)]
    others = tuple(each for each in before.headers if each[0] != name)
    headers = others + tuple((f"{name}x", value) for other, value in before.headers if renamed and other == name)
    assert answer_to(replace(before, headers=headers), store) in REFUSALS


@pytest.mark.parametrize("names", ["x-amz-date;host", "host;host;x-amz-date", "Host;x-amz-date", "host;;x-amz-date"])
def test_the_signed_headers_are_sorted_lower_case_and_unique(store: KeyStore, key: Key, names: str) -> None:
    before = signed(Sent("GET", "/", "", (), b""), signer_of(key, "batch", "us-east-1"))
    changed = header(before, "authorization").replace("SignedHeaders=host;x-amz-date", f"SignedHeaders={names}")
    others = tuple(each for each in before.headers if each[0] != "authorization")
    assert answer_to(replace(before, headers=(*others, ("authorization", changed))), store) == "IncompleteSignature"


@settings(max_examples=50)
@given(requests(), places, st.text(LETTERS, max_size=5))
def test_a_header_of_amazons_that_is_added_after_signing_is_refused(
    store: KeyStore, key: Key, sent: Sent, place: tuple[str, str], value: str
) -> None:
    before = signed(sent, signer_of(key, *place))
    added = replace(before, headers=(*before.headers, ("x-amz-target", value)))
    assert answer_to(added, store) == "InvalidSignatureException"


@settings(max_examples=50)
@given(requests(), places)
def test_a_body_that_botocore_leaves_unsigned_is_refused(
    store: KeyStore, key: Key, sent: Sent, place: tuple[str, str]
) -> None:
    request = sent.to_sign()
    request.context["payload_signing_enabled"] = False
    signer_of(key, *place).add_auth(request)
    assert request.headers["X-Amz-Content-SHA256"] == "UNSIGNED-PAYLOAD"
    headers = (("host", HOST), *((name.lower(), value) for name, value in request.headers.items()))
    assert answer_to(replace(sent, headers=headers), store) == "InvalidSignatureException"


@pytest.mark.parametrize("service", ["batch", "logs"])
def test_an_address_that_was_signed_beforehand_is_not_served(store: KeyStore, key: Key, service: str) -> None:
    request = AWSRequest("GET", f"https://{HOST}/api/runs?after=1")
    SigV4QueryAuth(Credentials(key.access_key_id, key.secret), service, "us-east-1").add_auth(request)
    query = urlsplit(request.url).query
    assert "X-Amz-Signature=" in query
    assert answer_to(Sent("GET", "/api/runs", query, (("host", HOST),), b""), store) == "MissingAuthenticationToken"
