"""The bus that a robot is on: LCM, whose own constructor says nothing of a URL that it cannot open."""

from __future__ import annotations

from ipaddress import IPv4Address
from urllib.parse import urlsplit

from pydrake.lcm import DrakeLcm

from guiderail.models.common.errors import InputError, brief

PROVIDERS = ("udpm", "mpudpm", "tcpq", "memq")


def open_bus(url: str) -> DrakeLcm:
    """The bus at `url`, LCM's own default where that is empty.

    Raises:
        InputError: for a URL at which messages would go nowhere.
    """
    if url:
        _check(url)
    return DrakeLcm(url)


def _check(url: str) -> None:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise InputError(f"{brief(url)} is no URL of LCM: {error}") from None
    if parts.scheme not in PROVIDERS or "://" not in url:
        raise InputError(f"{brief(url)} is no URL of LCM, such as udpm://239.255.76.67:7667?ttl=0 or memq://")
    if parts.scheme in ("udpm", "mpudpm") and host is not None:
        try:
            is_group = IPv4Address(host).is_multicast
        except ValueError:
            is_group = False
        if not is_group or port == 0:
            raise InputError(f"{brief(url)}: LCM's messages go to a multicast address, 224.0.0.0 to 239.255.255.255")
