"""The one error tree. Every message says what is wrong, where, and how to fix it."""


class SemanticMapperError(Exception):
    """Base of every error this project raises on purpose."""


class ShapeError(SemanticMapperError, ValueError):
    """An array has another shape or dtype than the call asks for."""


class FrameError(SemanticMapperError, ValueError):
    """One frame cannot be used; the frames around it can."""


class PoseError(FrameError):
    """A pose is not a rigid transform (NaN, not a rotation, wrong last row)."""


class LabelError(SemanticMapperError, ValueError):
    """A class id or name is not in the label set at hand."""


class ConfigError(SemanticMapperError, ValueError):
    """A configuration file or value cannot be used."""


class CodecError(SemanticMapperError, ValueError):
    """Bytes from a socket or a log are not a message of ours."""


class TransportError(SemanticMapperError, OSError):
    """A socket cannot be opened, or the other side is missing or does not keep up."""


class LogError(SemanticMapperError):
    """A recorded log cannot be opened or read."""


class EmptyMapError(LogError):
    """A recording has no frame that can be mapped."""


class ImportSourceError(SemanticMapperError):
    """A foreign recording cannot be imported."""


class WeightsError(SemanticMapperError):
    """A weights file is missing, damaged, or does not fit the model or label set."""


class MapError(SemanticMapperError):
    """The voxel map, or a saved one, cannot be used as requested."""


class DependencyError(SemanticMapperError, ImportError):
    """A package or system library that a feature needs cannot be loaded."""


class CameraError(SemanticMapperError, OSError):
    """A camera, or what tells its pose, is not there, cannot be opened, or does not do what is requested of it."""


class NodeError(SemanticMapperError, RuntimeError):
    """A node process could not start, or ended when it should not have."""


class StoreError(SemanticMapperError, OSError):
    """A store of results, or an object in it, cannot be reached, read or written."""


class FleetError(SemanticMapperError, RuntimeError):
    """A cluster cannot be started or joined, or does not run what it was given."""
