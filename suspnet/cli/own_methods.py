"""Methods and feature sets of a user, which a script of theirs registers."""

import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

from hydra.core.config_store import ConfigStore

from suspnet.cli.kinds import KINDS
from suspnet.curves.components import FEATURE_SETS
from suspnet.curves.extraction import FeatureSet
from suspnet.learning import METHODS
from suspnet.runs.tables import MODEL_TITLES, REFINED

NAME = re.compile(r"[a-z][a-z0-9_]*", re.ASCII)
METHOD_NAMES = ("fit", "predict", "get_params", "set_params", "state", "restore")
"""Attributes that a registered method must have."""
FEATURE_NAMES = ("kind", "positive", "parts", "names", "extract", "missing", "relative")
"""Attributes that a registered feature set must define itself."""
WITH_DEFAULTS = ("is_fitted", "fitted", "blank", "state", "restored")
"""Attributes of a registered feature set that those of ``FeatureSet`` will do for."""
SHIPPED = frozenset(METHODS), frozenset(FEATURE_SETS)


def register_method(name: str, cls: type, title: str | None = None) -> None:
    """Make a regression available as ``model=NAME``, in tables, and in saved models.

    A name may be registered again, for instance by a notebook's cell that is run twice.

    Parameters
    ----------
    name : str
        Lower-case letters, digits and underscores.
    cls : type
        A scikit-learn regressor that also has ``state()``, which returns what the fitted method
        needs as finite arrays of floats, and ``restore(arrays)``. ``model=NAME`` has the defaults
        of its constructor.
    title : str, optional
        Its name in tables; `name` if left out.

    Raises
    ------
    TypeError, ValueError
        If `cls` could not be saved, or the name, the title or a default is taken or not plain.
    """
    _check_name("name", name, SHIPPED[0])
    lacking = [attribute for attribute in METHOD_NAMES if not hasattr(cls, attribute)]
    if not isinstance(cls, type) or lacking:
        raise TypeError(
            f"`cls` of the method {name!r} lacks {', '.join(lacking) or 'a class'}, without which "
            "its models cannot be saved; train(problem, regressor) scores it without saving"
        )
    title = name if title is None else title
    if any(title == other for key, other in MODEL_TITLES.items() if key != name):
        raise ValueError(f"`title` {title!r} is that of another method")
    settings = _defaults(name, cls)
    if not hasattr(cls, "works_on_curves"):
        cls.works_on_curves = False  # type: ignore[attr-defined]
    METHODS[name] = cls
    MODEL_TITLES[name], MODEL_TITLES[name + REFINED] = title, f"{title} refined"
    KINDS["model"][name] = cls
    ConfigStore.instance().store(group="model", name=name, node={"kind": name, **settings})


def register_features(cls: type) -> None:
    """Make a feature set available as ``protocol.feature_set=KIND``, ``KIND`` being ``cls.kind``.

    Parameters
    ----------
    cls : type
        A dataclass with what ``suspnet.FeatureSet`` lists, most simply one derived from it. Its
        fields are set by ``protocol.feature_settings``.

    Raises
    ------
    TypeError, ValueError
        If `cls` is no dataclass or lacks an attribute, or its kind is taken or not plain.
    """
    if not isinstance(cls, type) or not is_dataclass(cls):
        raise TypeError(f"`cls` must be a dataclass, got {cls!r}")
    lacking = [
        attribute
        for attribute in FEATURE_NAMES  # those of `FeatureSet` itself are declarations
        if inspect.getattr_static(cls, attribute, None) is vars(FeatureSet).get(attribute)
    ]
    lacking += [attribute for attribute in WITH_DEFAULTS if not hasattr(cls, attribute)]
    if lacking:
        raise TypeError(
            f"the feature set {cls.__name__} lacks {', '.join(lacking)}; suspnet.FeatureSet, from "
            f"which it may be derived, says what these are, and has {', '.join(WITH_DEFAULTS)}"
        )
    kind = cls.kind  # type: ignore[attr-defined]
    _check_name("kind", kind, SHIPPED[1])
    FEATURE_SETS[kind] = cls


def _check_name(key: str, name: Any, shipped: frozenset[str]) -> None:
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(
            f"`{key}` must be lower-case letters, digits and underscores, got {name!r}"
        )
    if name in shipped:
        raise ValueError(f"`{key}` {name!r} is one of suspnet's own; take another")


def _defaults(name: str, cls: type) -> Mapping[str, Any]:
    """Return the defaults of a constructor; "???" where an argument has none."""
    defaults: dict[str, Any] = {}
    for key, argument in inspect.signature(cls).parameters.items():
        if argument.kind in (argument.VAR_KEYWORD, argument.VAR_POSITIONAL):
            continue
        value = "???" if argument.default is argument.empty else argument.default
        try:
            json.dumps(value)
        except TypeError as error:
            raise ValueError(
                f"the default of `{key}` of the method {name!r} must be a number, a text, a list "
                f"of these or None, got {value!r}: nothing else can be saved"
            ) from error
        defaults[key] = list(value) if isinstance(value, tuple) else value
    return defaults
