"""Every error a user or a file can cause, as one family; each kind is also the built-in it resembles."""


class OpenVocabOccError(Exception):
    """Base of all errors raised on purpose.

    The message reads: what was wrong: expected this, got that; do this.
    """

    def __init__(self, what: str, *, expected: object = None, got: object = None, fix: str | None = None) -> None:
        self.what = what
        self.expected = expected
        self.got = got
        self.fix = fix
        facts = [f"expected {expected}"] * (expected is not None) + [f"got {got}"] * (got is not None)
        message = what + (": " + ", ".join(facts) if facts else "") + (f"; {fix}" if fix else "")
        super().__init__(message)

    def __str__(self) -> str:
        return str(self.args[0])


class ConfigError(OpenVocabOccError, ValueError):
    """An option or argument that makes no sense, or a name that is not known."""


class DataError(OpenVocabOccError, ValueError):
    """Content of a file or an array that cannot be right."""


class ShapeError(DataError):
    """An array of another shape or dtype than the one asked for."""


class PoseError(DataError):
    """A pose that is not a rigid motion, or not finite."""


class CameraError(DataError):
    """Intrinsics or distortion that describe no camera."""


class GridError(DataError):
    """An occupancy grid whose labels, size or classes contradict each other."""


class ModelError(DataError):
    """A model file that cannot be used, or does not do what its card says."""


class CardError(ModelError):
    """A model card that is incomplete, misspelt, or of the wrong type."""


class MapError(DataError):
    """A saved map that is damaged, from the future, or not a map."""


class StorageError(OpenVocabOccError, OSError):
    """A disk or store that does not take what is written: full, read-only, gone, or fought over."""


class EncoderMismatchError(MapError):
    """A query by another encoder than the one that made the map."""


class UnsafeFileError(DataError):
    """A file that asks for more than plain data: code to run, paths outside its folder."""


class QueryError(OpenVocabOccError, ValueError):
    """A query that cannot be read."""


class NotFoundError(OpenVocabOccError, FileNotFoundError):
    """A file or folder that should be there and is not."""


class AlreadyExistsError(OpenVocabOccError, FileExistsError):
    """An output that would overwrite something it should not."""


class MissingExtraError(OpenVocabOccError, ImportError):
    """An optional dependency that is not installed."""
