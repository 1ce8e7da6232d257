"""The exceptions of sattools: one root, so that callers can catch everything the suite raises on purpose.

Every message is one line that names the file, what was found and what was expected.
"""


class SattoolsError(Exception):
    """Root of all errors that sattools raises on purpose."""


class InputError(SattoolsError, ValueError):
    """An input file or value cannot be used."""


class SceneError(SattoolsError, ValueError):
    """A scene document is malformed or does not hold what a command needs."""


class OutputExistsError(SattoolsError, FileExistsError):
    """An output is already there and overwriting was not asked for."""


class OutputIsInputError(SattoolsError, ValueError):
    """A command was about to write onto a file that it reads; it never does, whatever it is told."""


class StaleError(SceneError):
    """A product was made from something that has changed since."""
