"""Diagnosis of endpoints that cannot be reached, since Zenoh only retries and does not report the reason."""

from __future__ import annotations

import socket
import ssl
from contextlib import suppress

from trirail.wire import tls
from trirail.wire.credentials import Credentials
from trirail.wire.endpoints import ReachableBy, fault_of, reach, socket_file, tcp_address
from trirail.wire.text import quoted

CONNECT_TIMEOUT_S = 2.0
"""Time-out for opening a connection [s]."""
REJECTION_TIMEOUT_S = 0.3
"""Time to wait for the server's rejection of the client's certificate [s].

In TLS 1.3, the client completes its handshake before the server has checked the client's certificate."""


def connection_problem(endpoint: str, credentials: Credentials | None = None, name: str | None = None) -> str:
    """Connect to an endpoint, and return the problem that TCP or TLS reports; "" if there is no problem.

    `name` is the common name that the server's certificate must have; None accepts every name.
    """
    if fault := fault_of(endpoint):
        return fault
    address, file = tcp_address(endpoint), socket_file(endpoint)
    try:
        if file is not None:
            with socket.socket(socket.AF_UNIX) as opened:
                opened.connect(str(file))
        if address is None:
            return ""
        with socket.create_connection(address, CONNECT_TIMEOUT_S) as opened:
            secured = credentials is not None and reach(endpoint) is ReachableBy.CERTIFICATE
            return _tls_problem(opened, address[0], credentials, name) if credentials and secured else ""
    except ssl.SSLCertVerificationError as error:
        return f"the server's certificate is not trusted: {error.verify_message}"
    except ssl.SSLError as error:
        return f"the server rejects this certificate: {(error.reason or str(error)).lower().replace('_', ' ')}"
    except socket.gaierror as error:
        return f"unknown host name: {str(error.strerror).lower()}"
    except UnicodeError:
        return "invalid host name"
    except TimeoutError:
        return f"no answer within {CONNECT_TIMEOUT_S:g} s"
    except OSError as error:
        return (error.strerror or str(error)).lower()


def _tls_problem(opened: socket.socket, host: str, credentials: Credentials, name: str | None) -> str:
    from cryptography import x509  # imported here, so that clients without certificates do not wait for the import

    from trirail.wire.certificates import common_name

    with tls.client(credentials).wrap_socket(opened, server_hostname=host) as secured:
        shown = common_name(x509.load_der_x509_certificate(secured.getpeercert(binary_form=True) or b""))
        if name not in (None, shown):
            return f"the server's certificate has the name {quoted(shown) or '(none)'}, expected {name}"
        secured.settimeout(REJECTION_TIMEOUT_S)
        with suppress(TimeoutError):
            secured.recv(1)
    return ""
