"""Composes each choice of shipped configurations once: programs compose the same ones in each test.

What is typed or checked is applied to a copy each time, and a user's folder is always read.
"""

import copy
from contextlib import contextmanager

import pytest
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from omegaconf import OmegaConf

from suspnet.cli.program import CONFIGS


@contextmanager
def composed_once():
    """Keep lists of defaults and what they compose to, and each text of a configuration.

    What fails is tried again each time, so that errors are those of the file.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(_loads_once(OmegaConf.load)))
        listed = _listed_once(defaults_list._create_defaults_list)
        patch.setattr(defaults_list, "_create_defaults_list", listed)
        name = "_compose_config_from_defaults_list"
        patch.setattr(ConfigLoaderImpl, name, _merged_once(getattr(ConfigLoaderImpl, name)))
        yield


def _loads_once(load):
    known = {}

    def loaded(file_):
        if not hasattr(file_, "read"):
            return load(file_)
        begin, text = file_.tell(), file_.read()
        if text not in known:
            file_.seek(begin)
            known[text] = load(file_)
        return copy.deepcopy(known[text])

    return loaded


def _listed_once(make):
    known = {}

    def listed(repo, config_name, overrides, prepend_hydra, skip_missing):
        sources = _shipped(repo)
        if sources is None:
            return make(repo, config_name, overrides, prepend_hydra, skip_missing)
        typed = {k: v for k, v in vars(overrides).items() if k != "config_overrides"}
        key = (sources, config_name, repr(typed), prepend_hydra, skip_missing)
        if key not in known:
            found, tree = make(repo, config_name, overrides, prepend_hydra, skip_missing)
            known[key] = copy.deepcopy((found, typed))  # `typed` has been changed with `overrides`
            return found, tree
        found, used = copy.deepcopy(known[key])
        vars(overrides).update(used)
        return found, None

    return listed


def _merged_once(merge):
    known = {}

    def merged(self, defaults, repo):
        sources = _shipped(repo)
        if sources is None:
            return merge(self, defaults, repo)
        key = (sources, repr(defaults))
        if key not in known:
            known[key] = merge(self, defaults, repo)
        return copy.deepcopy(known[key])

    return merged


def _shipped(repo):
    """Return where configurations come from, or None if one place is not the package's."""
    sources = tuple((source.scheme(), source.path) for source in repo.get_sources())
    return None if any(s == "file" and path != CONFIGS for s, path in sources) else sources
