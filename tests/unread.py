"""A pipe whose writer still works, for tests of what commands tell before they wait for it."""

import io


class Unread(io.BytesIO):
    """A pipe on which nothing has come yet."""

    def readline(self, size: int | None = -1) -> bytes:
        raise AssertionError("the command has waited for a scene")
