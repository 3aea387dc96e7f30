"""Errors of an S3 server and its client as errors of the store, in one line that quotes no request: it has a signature.

An answer decides by its status and its code (https://docs.aws.amazon.com/AmazonS3/latest/API/ErrorResponses.html):
5xx, throttling and a body that did not arrive whole pass, and everything else needs a person.
"""

from typing import Any

from storage.errors import StorageError, Unavailable

_PASSING_STATUS = {408, 409, 425, 429}
_PASSING_CODES = {
    "BadDigest", "IncompleteBody", "InternalError", "OperationAborted", "RequestTimeout", "ServiceUnavailable",
    "SlowDown", "Throttling", "XAmzContentChecksumMismatch", "XAmzContentSHA256Mismatch",
}  # fmt: skip
_NETWORK = {
    "ClientError",
    "ConnectionError",
    "HTTPClientError",
    "OSError",
    "ResponseParserError",
    "IncompleteReadError",
}
"""Base classes, in aiohttp, asyncio, botocore and Python, of errors without a whole answer."""
_KEYS = "see AWS_ACCESS_KEY_ID, AWS_PROFILE"
_ADVICE = {
    "InvalidAccessKeyId": f"it does not know the key: {_KEYS}",
    "SignatureDoesNotMatch": f"the secret does not belong to the key: {_KEYS}",
    "ExpiredToken": f"the key has expired: {_KEYS}",
    "RequestTimeTooSkewed": "this machine's clock and the server's differ by too much: set it right",
    "AccessDenied": f"the key may not do that: {_KEYS}",
    "403": f"key, secret, rights or this machine's clock: {_KEYS}",  # the answer to HEAD has no text
}


def server_error(what: str, bucket: str, error: Exception) -> StorageError:
    """Return the error of a failed request: Unavailable where it may pass. `what` says what cannot be done."""
    if (answer := _answer(error)) is not None:
        return _refused(what, bucket, *answer)
    kind = type(error).__name__
    if isinstance(error, FileNotFoundError):
        return _no_bucket(what, bucket)
    if "Credential" in kind or "Token" in kind:
        return StorageError(f"{what}: no keys for it, {_KEYS} ({kind}).")
    if not _bases(error).isdisjoint(_NETWORK):
        return Unavailable(f"{what}: the server does not answer ({kind})")
    return StorageError(
        f"{what}: the settings of the server are not possible ({kind}), see AWS_ENDPOINT_URL, AWS_PROFILE."
    )


def is_cut(error: Exception) -> bool:
    """Return whether the answer began and did not arrive whole."""
    return not _bases(error).isdisjoint(("ClientPayloadError", "IncompleteReadError"))


def is_changed(error: Exception) -> bool:
    """Return whether the bytes that arrived do not have the server's checksum."""
    return not _bases(error).isdisjoint(("ChecksumError", "FlexibleChecksumError"))


def _bases(error: Exception) -> set[str]:
    return {base.__name__ for base in type(error).__mro__}


def _answer(error: BaseException | None) -> tuple[int, str] | None:
    """Return status and code of the server's answer; None if there was none."""
    while error is not None:
        response: Any = getattr(error, "response", None)
        if isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0)
            return int(status), str(response.get("Error", {}).get("Code") or status)
        error = error.__cause__
    return None


def _refused(what: str, bucket: str, status: int, code: str) -> StorageError:
    if status >= 500 or status in _PASSING_STATUS or code in _PASSING_CODES:
        return Unavailable(f"{what}: the server cannot do it now ({code})")
    if status == 404 or code in ("404", "NoSuchBucket"):
        return _no_bucket(what, bucket)
    why = _ADVICE.get(code) or _ADVICE.get(str(status), "")
    return StorageError(f"{what}: the server refuses it ({code}){why and f': {why}'}.")


def _no_bucket(what: str, bucket: str) -> StorageError:
    return StorageError(f"{what}: there is no bucket {bucket!r}: make it first.")
