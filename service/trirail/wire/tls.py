"""TLS beside Zenoh's own: both sides show a certificate, and each believes only its authority."""

from __future__ import annotations

import ssl
from typing import Any

from trirail.wire.credentials import Credentials


def server(credentials: Credentials) -> ssl.SSLContext:
    """Return the context of who is connected to."""
    authority, certificate, key = credentials.files
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(authority))
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(certificate, key)
    return context


def client(credentials: Credentials) -> ssl.SSLContext:
    """Return the context of who connects: the host's name or address must be in the other's certificate."""
    authority, certificate, key = credentials.files
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(authority)
    context.load_cert_chain(certificate, key)
    return context


def peer(connection: ssl.SSLSocket) -> str:
    """Return in whose name the certificate is that was shown; "" without one, or where it has no one name."""
    subject: Any = (connection.getpeercert() or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    return names[0] if len(names) == 1 else ""
