"""Read the value of the option ``--device`` of a command: a description of a device, or the name of a device file.

A device file (YAML or JSON) describes one device, with the keys below ``device`` in a configuration file. A description
is the name of a published device, a transfer function, or the name of a file with a measured frequency response.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from pydantic import BeforeValidator, RootModel

from zwidth.config.devices import DeviceForm
from zwidth.config.fields import problem
from zwidth.config.reader import read_model
from zwidth.core.errors import InputError
from zwidth.model.device import Device
from zwidth.model.devices import PublishedDevice, read_device
from zwidth.model.linear_device import LinearDevice
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.mujoco_model import MODEL_SUFFIXES

_SUFFIXES = (".yaml", ".yml", ".json")


def _refuse_configuration(raw: Any) -> Any:
    """Return the content of a device file unchanged; raise an error if it is a complete configuration file."""
    if isinstance(raw, dict) and "version" in raw:
        allowed = "a file for --device has the keys of one device"
        raise problem("got a whole configuration", allowed, "give its name without --device")
    return raw


class _DeviceFile(RootModel[Annotated[DeviceForm, BeforeValidator(_refuse_configuration)]]):
    """Pydantic model of the content of a device file."""


def read_device_option(
    text: str, sampled: Any = None, *, rotary: bool = False
) -> PublishedDevice | Device | LinearDevice | MeasuredDevice:
    """Return the device that the value of the option ``--device`` describes.

    Args:
        text: value of the option: the name of a device file, or a description that `zwidth.model.devices.read_device`
            accepts. Names of other files in a device file are relative to the folder of the device file.
        sampled: sampling period in s for a transfer function in z; None for a transfer function in s.
        rotary: True if other options have rotary units; a device given by a transfer function is then rotary.

    Raises:
        InputError: ``text`` describes no device, or ``sampled`` is given for a device that is not a transfer function.
        ConfigError: the device file cannot be read or is invalid.
    """
    if text.endswith(MODEL_SUFFIXES):
        raise InputError(
            f"device: got {text!r}, a model without point and direction; write model, site and direction into a file "
            "DEVICE.yaml and give its name"
        )
    if not text.endswith(_SUFFIXES):
        device = read_device(text, sampled)
        return replace(device, rotary=rotary) if isinstance(device, LinearDevice) else device
    if sampled is not None:
        raise InputError(f"device: got {text!r} with --sampled; write the key 'sampled' into the file")
    section: Any = read_model(text, _DeviceFile).root
    return section.instance
