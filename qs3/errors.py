"""Errors that are meant for the user: the command line prints them without a traceback."""


class Qs3Error(Exception):
    """Base of all errors caused by input, settings or surroundings."""


class ConfigError(Qs3Error):
    """A setting is out of range or contradicts another one."""


class MissingDataError(Qs3Error):
    """A dataset, folder or file that was asked for is not there."""


class DataError(Qs3Error):
    """A file is there but damaged, or does not hold what its format promises."""


class MeshError(DataError):
    """A mesh is empty, not finite, truncated or unreadable."""


class MeshUnavailableError(MeshError):
    """A file that was there cannot be read now: the disk is to blame, and not the mesh."""


class RenderError(Qs3Error):
    """A renderer cannot be used here, or failed."""


class SelectionError(Qs3Error):
    """A round of self-training selected too little to train on."""
