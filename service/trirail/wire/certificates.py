"""X.509 certificates (P-256) with which robots and users authenticate each other, and the authority that signs them.

A user's certificate is valid for clients only, so a user cannot impersonate the robot. A robot's certificate lists the
addresses at which clients connect. It is valid for servers and clients, because a robot can also connect to a router.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS = 3650
"""Validity of an authority's certificate [days]."""
AUTHORITY_SUFFIX = " authority"
"""Text after the robot's name in the name of its authority."""
LONGEST_ROBOT = 54
"""Maximum number of characters of the robot's name in that of its authority, since X.509 allows common names of 64."""
CLOCK_TOLERANCE = timedelta(minutes=10)
"""Time by which the validity of a certificate begins before its creation, because the clocks of machines differ."""


class Pair(NamedTuple):
    """A certificate and its private key, as PEM."""

    certificate: bytes
    key: bytes


def authority(robot: str, now: datetime | None = None) -> Pair:
    """Return a new authority, which consists of a self-signed certificate and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"{robot[:LONGEST_ROBOT]}{AUTHORITY_SUFFIX}")
    builder = (
        _builder(name, key.public_key(), now or datetime.now(UTC), AUTHORITY_DAYS)
        .issuer_name(name)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
    )
    return Pair(_pem(builder.sign(key, hashes.SHA256())), _key_pem(key))


def issue(
    by: Pair,
    name: str,
    days: float,
    addresses: Sequence[str] = (),
    *,
    serves: bool = False,
    now: datetime | None = None,
) -> Pair:
    """Return a new private key and its certificate, which the authority `by` signs.

    Parameters
    ----------
    by
        Authority that signs the certificate.
    name
        Common name of the certificate.
    days
        Validity [days], which ends with that of the authority at the latest.
    addresses
        Host names and IP addresses at which clients connect to a robot.
    serves
        If True, the certificate is for a robot or router. If False, it is valid for clients only.

    """
    key = ec.generate_private_key(ec.SECP256R1())
    return Pair(_certificate(by, name, key.public_key(), days, addresses, serves, now), _key_pem(key))


def renew(by: Pair, certificate: bytes, days: float, now: datetime | None = None) -> bytes:
    """Return a copy of a certificate with the same key that is valid for `days` from now, as with `issue`.

    Raises ValueError if the certificate is not a valid PEM certificate with an elliptic-curve key.
    """
    old = x509.load_pem_x509_certificate(certificate)
    key = old.public_key()
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise ValueError("the certificate's key is not an elliptic-curve key")  # noqa: TRY004 - content of a file
    return _certificate(by, common_name(old), key, days, addresses_of(old), serves(old), now)


def common_name(certificate: x509.Certificate) -> str:
    """Return the common name of a certificate; "" if the certificate has no common name or several."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if len(names) == 1 else ""


def serves(certificate: x509.Certificate) -> bool:
    """Return True if the certificate is for a robot or router, False if it is valid for clients only."""
    try:
        purposes = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return False
    return ExtendedKeyUsageOID.SERVER_AUTH in purposes


def addresses_of(certificate: x509.Certificate) -> list[str]:
    """Return the IP addresses and host names in a robot's certificate."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [*map(str, names.get_values_for_type(x509.IPAddress)), *names.get_values_for_type(x509.DNSName)]


def _builder(
    subject: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, days: float, latest: datetime | None = None
) -> x509.CertificateBuilder:
    """Return the builder of a certificate that is valid for `days` from `now`, but not after `latest`."""
    expires = now + timedelta(days=days)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_TOLERANCE)
        .not_valid_after(min(expires, latest or expires))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _certificate(
    by: Pair,
    name: str,
    key: ec.EllipticCurvePublicKey,
    days: float,
    addresses: Sequence[str],
    serves: bool,
    now: datetime | None,
) -> bytes:
    issuer = x509.load_pem_x509_certificate(by.certificate)
    issuer_key = serialization.load_pem_private_key(by.key, password=None)
    if not isinstance(issuer_key, ec.EllipticCurvePrivateKey):
        raise ValueError("the authority's key is not an elliptic-curve key")  # noqa: TRY004 - content of a file
    identifier = issuer.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if serves else [])]
    builder = (
        _builder(_name(name), key, now or datetime.now(UTC), days, issuer.not_valid_after_utc)
        .issuer_name(issuer.subject)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier), critical=False)
    )
    if addresses:
        builder = builder.add_extension(x509.SubjectAlternativeName([_address(each) for each in addresses]), False)
    return _pem(builder.sign(issuer_key, hashes.SHA256()))


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)] if common else [])


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)
