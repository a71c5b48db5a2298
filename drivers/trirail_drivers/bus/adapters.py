"""Python packages and manufacturers' libraries that some of python-can's interfaces need."""

from __future__ import annotations

from ctypes.util import find_library
from importlib.util import find_spec
from typing import Final

_PACKAGES: Final = {
    "canalystii": (("canalystii",), "canalystii"),
    "cantact": (("cantact",), "cantact"),
    "gs_usb": (("gs_usb", "usb"), "gs-usb"),
    "neovi": (("ics", "filelock"), "neovi"),
    "robotell": (("serial",), "serial"),
    "seeedstudio": (("serial",), "seeedstudio"),
    "serial": (("serial",), "serial"),
    "slcan": (("serial",), "serial"),
    "udp_multicast": (("msgpack",), "multicast"),
}
"""For each interface, the modules that it imports and the python-can extra that installs them."""
_LIBRARIES: Final = {
    "kvaser": ("canlib", "Kvaser's CANlib"),
    "pcan": ("pcanbasic", "PEAK's PCAN-Basic"),
}
"""For each interface, the library of the adapter's manufacturer. Linux has its own drivers for these adapters."""


def missing_support(interface: str) -> str:
    """Return which module or library an interface lacks on this machine and how to install it; "" if none is known."""
    modules, extra = _PACKAGES.get(interface, ((), ""))
    if missing := [module for module in modules if find_spec(module) is None]:
        return f"the Python module {missing[0]}; install it with: pip install 'python-can[{extra}]'"
    library, product = _LIBRARIES.get(interface, ("", ""))
    if library and find_library(library) is None:
        return (
            f"{product} (lib{library}.so), which is not installed; on Linux, these adapters work without it: "
            'interface = "socketcan", channel = "can0"'
        )
    return ""
