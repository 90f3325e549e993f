"""Objects whose attributes are set by their constructor and never again."""

from __future__ import annotations

from functools import wraps
from typing import Any


class Immutable:
    """Base of classes whose instances do not change after construction.

    Not a frozen dataclass: Dr.Jit treats the fields of dataclasses that a symbolic loop reads as
    state variables of the loop, which it copies; it cannot assign them if they are frozen.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__init__" not in cls.__dict__:
            return
        initialise = cls.__init__

        @wraps(initialise)
        def construct(self: Immutable, *args: Any, **kwargs: Any) -> None:
            initialise(self, *args, **kwargs)
            if type(self) is cls:  # otherwise the constructor of a derived class has not finished
                self.__dict__["_is_complete"] = True

        cls.__init__ = construct

    def attributes(self) -> dict[str, Any]:
        """Return all attributes by name, except private ones."""
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setattr__(self, name: str, value: object) -> None:
        if "_is_complete" in self.__dict__:
            raise AttributeError(
                f"{type(self).__name__}.{name} cannot be set: the object is immutable, construct "
                "another one"
            )
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{type(self).__name__}.{name} cannot be deleted")
