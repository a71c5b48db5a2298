"""TLS of the stop port: both sides authenticate with a certificate, and each trusts only its own authority."""

from __future__ import annotations

import ssl
from typing import Any

from trirail.wire.credentials import Credentials


def server(credentials: Credentials) -> ssl.SSLContext:
    """Return the context of a server, which requires a client certificate."""
    authority, certificate, key = credentials.files
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(authority))
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_cert_chain(certificate, key)
    return context


def client(credentials: Credentials) -> ssl.SSLContext:
    """Return the context of a client; the server's certificate must contain its host name or address."""
    authority, certificate, key = credentials.files
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(authority)
    context.load_cert_chain(certificate, key)
    return context


def peer(connection: ssl.SSLSocket) -> str:
    """Return the common name of the peer's certificate; "" without one, or if it has none or several."""
    subject: Any = (connection.getpeercert() or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    return names[0] if len(names) == 1 else ""
