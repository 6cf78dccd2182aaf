"""The errors that the core raises. Each message says what came, what was expected, what to try."""


class VFlattenError(Exception):
    """Base of every error that a caller can act on."""


class InvalidInput(VFlattenError):
    """An array or a value of the wrong shape, type or range."""


class InvalidConfig(VFlattenError):
    """A configuration value outside its range, or an unknown name."""


class InvalidCalibration(VFlattenError):
    """A calibration that lacks a key or describes no rig."""


class InvalidCloud(VFlattenError):
    """A point cloud message whose layout contradicts itself."""


class EmptyView(VFlattenError):
    """A cloud in which no item is seen below the gripper."""


class InvalidRecording(VFlattenError):
    """A recording that cannot be read, or lacks what the method needs."""


class InvalidCorrespondence(VFlattenError):
    """A corresponding point that lies in no view or outside the item."""


class NotEnoughViews(VFlattenError):
    """Fewer usable views than the method needs."""


class DisconnectedSurface(VFlattenError):
    """The observed surface falls into pieces that nothing joins."""


class Cancelled(VFlattenError):
    """The caller asked to stop; raised out of the progress callback."""
