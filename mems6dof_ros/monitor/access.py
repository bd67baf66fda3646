"""Who may talk to the page: the rules that keep other web sites and other people out.

A browser is easily led to send requests to localhost on behalf of any site it has open. Three rules
refuse them: the ``Host`` must be a name of this machine or an IP address (a rebound DNS name is
neither), an ``Origin``, where one is sent, must be the page's own, and beyond localhost everything
needs a token.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
import ssl
from functools import cache
from urllib.parse import quote, urlsplit

from mems6dof_ros.errors import InputError

COOKIE = "mems6dof_monitor"
#: A token chosen by hand has at least this many characters.
TOKEN_LENGTH = 16

SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches ``address``."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def choose_token(address: str, token: str) -> str:
    """The token to ask for; empty: none. Beyond localhost one is made where none is given.

    Raises InputError where the given one is too short to resist guessing.
    """
    if token and len(token) < TOKEN_LENGTH:
        raise InputError("token", f"{len(token)} characters", f"at least {TOKEN_LENGTH}")
    return token if token or is_loopback(address) else secrets.token_urlsafe(24)


def encryption(certificate: str, key: str) -> ssl.SSLContext | None:
    """What to encrypt with: ``certificate`` (with its chain) and ``key`` are PEM files; None: neither given.

    Raises InputError where only one is given, or they cannot be used.
    """
    if not certificate and not key:
        return None
    if not certificate or not key:
        raise InputError("encryption", "one of certificate and key", "both, or neither")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        # A password would be asked for on a terminal that a node may not have.
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"certificate {certificate}, key {key}",
            reason,
            "PEM files that belong together, the key without password",
        ) from error
    return context


def page_url(scheme: str, address: str, port: int, token: str) -> str:
    """What to open in a browser to see the page that is served on ``address``."""
    ip = ipaddress.ip_address(address)
    host = socket.gethostname() if ip.is_unspecified else f"[{ip}]" if ip.version == 6 else str(ip)
    return f"{scheme}://{host}:{port}/" + (f"?token={quote(token)}" if token else "")


def token_matches(given: str, token: str) -> bool:
    """Compare in a time that tells nothing of the token."""
    return hmac.compare_digest(given.encode(errors="surrogateescape"), token.encode())


def host_allowed(host: str) -> bool:
    """Whether a ``Host`` header names this machine, by its names or by any IP address."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name == "localhost" or name in _machine_names()
    return True


@cache
def _machine_names() -> frozenset[str]:
    return frozenset({socket.gethostname().lower(), socket.getfqdn().lower()})


def origin_allowed(origin: str, host: str) -> bool:
    """Whether an ``Origin`` header is that of the page itself, served under ``host``."""
    return origin in (f"http://{host}", f"https://{host}")
