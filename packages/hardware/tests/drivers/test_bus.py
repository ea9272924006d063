"""URLs of an LCM bus, which `DrakeLcm` does not check."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.lcm import open_bus


@pytest.mark.parametrize("url", ["memq://", "udpm://239.255.76.67:7668?ttl=0"])
def test_open_bus_has_the_given_url(url):
    assert open_bus(url).get_lcm_url() == url


def test_open_bus_has_the_default_url_when_none_is_given(monkeypatch):
    monkeypatch.delenv("LCM_DEFAULT_URL", raising=False)
    assert open_bus("").get_lcm_url().startswith("udpm://")


@pytest.mark.parametrize(
    "url",
    ["nonsense", "udp://239.255.76.67:7667", "memq:", "udpm://999.1.1.1:7667", "udpm://10.0.0.1:7667",
     "udpm://239.255.76.67:70000", "udpm://239.255.76.67:0", "udpm://host:7667", "UDPM://239.255.76.67:7667"],
)  # fmt: skip
def test_open_bus_raises_when_the_url_is_unusable(url):
    with pytest.raises(InputError, match="LCM"):
        open_bus(url)
