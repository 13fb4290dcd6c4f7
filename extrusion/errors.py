"""What a user is told when something is wrong: one line, with the remedy."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input. The message names the field, the value and the remedy.

    Args:
        field: What is wrong, as the user wrote it (``"materials.billet.nu"``, ``"--size"``).
        value: The value met.
        remedy: What to write instead.
    """

    def __init__(self, field: str, value: object, remedy: str) -> None:
        self.field, self.value, self.remedy = field, value, remedy
        super().__init__(f"{field} = {value!r}: {remedy}")


class StepError(RuntimeError):
    """A step could not be solved. The message gives its time, zone, place and a remedy."""
