"""Why an endpoint cannot be reached, in words: Zenoh says nothing of it, and only tries again."""

from __future__ import annotations

import socket
import ssl
from contextlib import suppress

from trirail.wire import tls
from trirail.wire.credentials import Credentials
from trirail.wire.endpoints import ReachableBy, fault_of, reach, socket_file, tcp_address
from trirail.wire.text import quoted

ANSWERS_WITHIN = 2.0
"""How long who listens may take to answer [s]."""
REFUSES_WITHIN = 0.3
"""How long after it who does not take our certificate may take to say so: TLS 1.3 lets us finish before [s]."""


def why_not(endpoint: str, credentials: Credentials | None = None, name: str | None = None) -> str:
    """Return what keeps from a session at an endpoint as far as TCP and TLS tell, "" where they tell nothing.

    `name` is in whose name the certificate there must be; None for anybody's.
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
        with socket.create_connection(address, ANSWERS_WITHIN) as opened:
            secured = credentials is not None and reach(endpoint) is ReachableBy.CERTIFICATE
            return _why_no_tls(opened, address[0], credentials, name) if credentials and secured else ""
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is not accepted: {error.verify_message}"
    except ssl.SSLError as error:
        return f"this certificate is not accepted there: {(error.reason or str(error)).lower().replace('_', ' ')}"
    except socket.gaierror as error:
        return f"its host name is not known: {str(error.strerror).lower()}"
    except UnicodeError:
        return "its host name is none"
    except TimeoutError:
        return f"no answer within {ANSWERS_WITHIN:g} s"
    except OSError as error:
        return (error.strerror or str(error)).lower()


def _why_no_tls(opened: socket.socket, host: str, credentials: Credentials, name: str | None) -> str:
    from cryptography import x509  # not at the top: whoever needs no certificates does not wait for it

    from trirail.wire.certificates import common_name

    with tls.client(credentials).wrap_socket(opened, server_hostname=host) as secured:
        shown = common_name(x509.load_der_x509_certificate(secured.getpeercert(binary_form=True) or b""))
        if name not in (None, shown):
            return f"its certificate is in the name of {quoted(shown) or 'nobody'}, not of {name}"
        secured.settimeout(REFUSES_WITHIN)
        with suppress(TimeoutError):
            secured.recv(1)
    return ""
