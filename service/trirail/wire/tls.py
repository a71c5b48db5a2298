"""TLS contexts of the stop port; both sides authenticate with certificates, and trust only their own authority."""

from __future__ import annotations

import ssl
from typing import Any

from trirail.wire.credentials import Credentials


def server(credentials: Credentials) -> ssl.SSLContext:
    """Return the context of a server, which requires certificates from clients."""
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
    """Return the common name in the peer's certificate.

    Return "" if the peer has no certificate, or if the certificate does not have exactly one common name.
    """
    subject: Any = (connection.getpeercert() or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    return names[0] if len(names) == 1 else ""
