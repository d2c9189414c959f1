"""The exception tree of everything that touches a device.

    DriverError
    ├── SettingError       outside what the device or its limits allow (also a ValueError)
    ├── MissingDependency  a vendor library or system package is not installed
    ├── DeviceNotFound     no device matches the name that was asked for
    ├── DeviceLost         the device was there and is gone (cable, power, crash of its server)
    ├── DeviceTimeout      the device did not answer in time
    ├── DeviceFault        the device answered with an error of its own
    └── InterlockOpen      an interlock or the emergency stop forbids output

A message names the parameter, its value and the requirement, then the remedy.
"""


class DriverError(Exception):
    """Root of the tree; catch it to catch every failure of a device."""


class SettingError(DriverError, ValueError):
    """A setting is not what the device accepts: the message says parameter, value, requirement."""


class MissingDependency(DriverError, ImportError):
    """A library or system package is missing: the message holds the command that installs it."""


class DeviceNotFound(DriverError):
    """No device of that name is present."""


class DeviceLost(DriverError):
    """The device disappeared while in use."""


class DeviceTimeout(DriverError, TimeoutError):
    """The device did not answer within the time allowed."""


class DeviceFault(DriverError):
    """The device reported an error of its own (SCPI error queue, fault frame, overrun)."""


class InterlockOpen(DriverError):
    """Output is forbidden until the interlock closes and the stop is reset."""
