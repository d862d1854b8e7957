"""Settings: type, range, unit and description, declared with the class that uses them; checks.

The comments in configs/, which `--help` shows, are made from these by a script.
"""

import functools
import math
import operator
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Setting:
    """Description and valid values of a setting.

    A dataclass declares it with the field, by `setting` or in the annotation. Bounds are those of
    `check_number`. `rule` is unit and range as text, if type and bounds do not cover them.

    Examples
    --------
    >>> @dataclass
    ... class Trip(Checked):
    ...     rate_hz: float = setting(100.0, "Rate of the samples", "Hz", above=0)
    >>> Trip(-1.0)
    Traceback (most recent call last):
    ValueError: `rate_hz` must be a finite number > 0, got -1.0
    """

    sentence: str
    unit: str = ""
    low: float | None = None
    above: float | None = None
    high: float | None = None
    below: float | None = None
    most: float | None = None
    rule: str = ""


def setting(default: Any, sentence: str, unit: str = "", **bounds: Any) -> Any:
    """Return a field of a dataclass with a default and a `Setting`."""
    return field(default=default, metadata={"setting": Setting(sentence, unit, **bounds)})


@dataclass(frozen=True)
class Declared:
    """A setting with its name and its type, without None; `is_optional` if it may be None."""

    name: str
    type: Any
    is_optional: bool
    setting: Setting

    @property
    def choices(self) -> tuple[Any, ...]:
        """Values of a choice; empty for any other setting."""
        return get_args(self.type) if get_origin(self.type) is Literal else ()

    def check(self, name: str, value: Any) -> None:
        """Raise TypeError or ValueError, whose message has `name`, unless a value is valid."""
        setting, several = self.setting, get_origin(self.type) is tuple
        if value is None and self.is_optional:
            return
        if self.choices:
            allowed = (*self.choices, None) if self.is_optional else self.choices
            check_choice(name, value, allowed)
        elif self.type is bool:
            check_flag(name, value)
        elif (get_args(self.type)[0] if several else self.type) in (int, float):
            bounds = {key: getattr(setting, key) for key in ("low", "above", "high", "below")}
            if several and len(value) != len(get_args(self.type)):
                return  # the class itself reports a wrong length
            for i, number in enumerate(value if several else [value]):
                check_number(
                    f"{name}[{i}]" if several else name,
                    number,
                    **bounds,
                    most=LARGEST if setting.most is None else setting.most,
                    whole=self.type is int,
                    optional=self.is_optional,
                )


def check_settings(values: Any, prefix: str = "") -> None:
    """Raise TypeError or ValueError unless each setting of an object is valid.

    Messages name a setting, preceded by `prefix` and a dot if that is given.
    """
    class_: Any = type(values)
    for name, declared in settings_of(class_).items():
        declared.check(f"{prefix}.{name}" if prefix else name, getattr(values, name))


class Checked:
    """Base of dataclasses that check their settings when they are made."""

    def __post_init__(self) -> None:
        check_settings(self)


@functools.cache
def settings_of(class_: Any) -> Mapping[str, Declared]:
    """Return the settings that a dataclass declares, by name; none of any other class."""
    if not is_dataclass(class_):
        return {}
    settings, hints = {}, get_type_hints(class_, include_extras=True)
    for field_ in fields(class_):
        hint = hints[field_.name]
        type_, note = get_args(hint)[:2] if get_origin(hint) is Annotated else (hint, None)
        declaration = field_.metadata.get("setting") or note
        if isinstance(declaration, Setting):
            parts = get_args(type_) if get_origin(type_) in (Union, UnionType) else (type_,)
            types = [part for part in parts if part is not NoneType]
            type_ = types[0] if len(types) == 1 else type_
            settings[field_.name] = Declared(field_.name, type_, NoneType in parts, declaration)
    return settings


LARGEST = 1e20
"""Largest plausible magnitude of a setting in SI units; its square and its cube are finite."""


def check_number(
    name: str,
    value: Any,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
    below: float | None = None,
    whole: bool = False,
    optional: bool = False,
    most: float = LARGEST,
) -> None:
    """Raise TypeError or ValueError unless `value` is a finite number within the bounds given.

    ``low <= value <= high``, ``above < value < below`` and abs(value) <= `most`, beyond which a
    value would overflow or need too much time or memory. `whole` requires an integer, `optional`
    allows None. A value that is not a number, or not whole, is a TypeError.
    """
    if optional and value is None:
        return
    comparisons = (
        (">=", operator.ge, low),
        (">", operator.gt, above),
        ("<=", operator.le, high),
        ("<", operator.lt, below),
    )
    given = [(sign, compare, bound) for sign, compare, bound in comparisons if bound is not None]
    stated = " and ".join(f"{sign} {bound:g}" for sign, _, bound in given)
    rule = f"{'a whole' if whole else 'a finite'} number {stated}".strip() + " or null" * optional
    if isinstance(value, bool) or not isinstance(value, Integral if whole else Real):
        raise TypeError(f"`{name}` must be {rule}, got {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if most < abs(number) < math.inf:
        raise ValueError(f"`{name}` must be at most {most:g} in magnitude, got {value}")
    is_inside = all(compare(number, bound) for _, compare, bound in given)
    if not math.isfinite(number) or not is_inside:
        raise ValueError(f"`{name}` must be {rule}, got {value}")


def check_flag(name: str, value: object) -> None:
    """Raise TypeError unless a setting is True or False; text such as "no" would count as True."""
    if not isinstance(value, bool):
        raise TypeError(f"`{name}` must be True or False, got {value!r}")


def check_choice(name: str, value: object, allowed: Collection[object]) -> None:
    """Raise ValueError unless a setting is one of those allowed."""
    if value not in tuple(allowed):
        raise ValueError(f"`{name}` must be one of {tuple(allowed)}, got {value!r}")
