"""The kernel's usbfs and libumockdev in Python: structures, request numbers, functions.

For 64-bit machines; written against umockdev 0.17.
"""

import ctypes as c
from types import SimpleNamespace
from typing import Any

PRELOAD = "libumockdev-preload.so.0"
LIBRARIES = (PRELOAD, "libumockdev.so.0", "libgobject-2.0.so.0", "libusb-1.0.so.0")


class Urb(c.Structure):
    """struct usbdevfs_urb of a 64-bit kernel."""

    _fields_ = [("type", c.c_uint8), ("endpoint", c.c_uint8), ("status", c.c_int), ("flags", c.c_uint)]
    _fields_ += [("buffer", c.c_void_p)]
    _fields_ += [(name, c.c_int) for name in ("buffer_length", "actual_length", "start_frame", "number_of_packets")]
    _fields_ += [("error_count", c.c_int), ("signr", c.c_uint), ("usercontext", c.c_void_p)]


class Memory(c.Structure):
    """struct UMockdevIoctlData (a GObject): a copy of the client's memory at `client_addr`."""

    _fields_ = [("g_class", c.c_void_p), ("ref_count", c.c_uint), ("qdata", c.c_void_p), ("data", c.c_void_p)]
    _fields_ += [("data_len", c.c_int), ("client_addr", c.c_ulong)]


def _ioctl(number: int, size: int = 0, direction: int = 2) -> int:
    """Return a request number of usbfs, as the kernel's _IO, _IOW (1) and _IOR (2) make it."""
    return (direction << 30 if size else 0) | size << 16 | ord("U") << 8 | number


SUBMIT, DISCARD = _ioctl(10, c.sizeof(Urb)), _ioctl(11)
REAP, REAP_NOW = _ioctl(12, 8, 1), _ioctl(13, 8, 1)
CAPABILITIES, GET_DRIVER = _ioctl(26, 4), _ioctl(8, 260, 1)
# Claim, release, set configuration, set interface, disconnect and claim, reset the device, reset an endpoint.
GRANTED = {_ioctl(15, 4), _ioctl(16, 4), _ioctl(5, 4), _ioctl(4, 8), _ioctl(27, 264), _ioctl(20), _ioctl(3, 4)}

CONTROL = 2  # a type of urb
Handler = c.CFUNCTYPE(c.c_int, c.c_void_p, c.c_void_p, c.c_void_p)

_P, _PP = c.c_void_p, c.POINTER(c.c_void_p)
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "testbed_new": (_P, []),
    "testbed_add_from_string": (c.c_int, [_P, c.c_char_p, _PP]),
    "testbed_attach_ioctl": (c.c_int, [_P, c.c_char_p, _P, _PP]),
    "testbed_detach_ioctl": (c.c_int, [_P, c.c_char_p, _PP]),
    "testbed_uevent": (None, [_P, c.c_char_p, c.c_char_p]),
    "ioctl_base_new": (_P, []),
    "ioctl_client_get_request": (c.c_ulong, [_P]),
    "ioctl_client_get_arg": (c.POINTER(Memory), [_P]),
    "ioctl_client_complete": (None, [_P, c.c_long, c.c_int]),
    "ioctl_data_resolve": (c.POINTER(Memory), [_P, c.c_size_t, c.c_size_t, _PP]),
    "ioctl_data_set_ptr": (c.c_int, [_P, c.c_size_t, _P]),
}


_OF_GOBJECT: dict[str, tuple[Any, list[Any]]] = {
    "connect": (c.c_ulong, [_P, c.c_char_p, Handler, _P, _P, c.c_int]),
    "unref": (None, [_P]),
}


def library() -> SimpleNamespace:
    """Return the functions of libumockdev that are used, by their names without prefix."""
    umockdev, gobject = c.CDLL("libumockdev.so.0"), c.CDLL("libgobject-2.0.so.0")
    functions = {name: getattr(umockdev, f"umockdev_{name}") for name in _FUNCTIONS}
    functions |= {"connect": gobject.g_signal_connect_data, "unref": gobject.g_object_unref}
    for name, (result, arguments) in {**_FUNCTIONS, **_OF_GOBJECT}.items():
        functions[name].restype, functions[name].argtypes = result, arguments
    return SimpleNamespace(**functions)
