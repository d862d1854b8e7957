"""Composes each choice of configurations once: programs compose the same ones in each test.

What is typed or checked is applied to a copy each time. A user's folder counts by its contents.
"""

import copy
import pickle
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import pytest
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from omegaconf import OmegaConf, _utils, base, grammar_parser

from suspnet.cli.program import CONFIGS

MAX_FILES, MAX_BYTES = 50, 100_000
"""A user's folder that holds more files, or a larger one, is always read."""


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
        patch.setattr(CachingConfigRepository, "__init__", _share_sources)
        parse = _parses_once(grammar_parser.parse)
        for module in (base, _utils):
            patch.setattr(module, "parse", parse)
        yield


def _share_sources(self, delegate):
    """Take over the list of sources, which Hydra copies with all that its store holds."""
    self.delegate = copy.copy(delegate)
    self.cache = {}


def _parses_once(parse):
    known = {}

    def parsed(*text_and_rules):
        if text_and_rules not in known:
            known[text_and_rules] = parse(*text_and_rules)
        return known[text_and_rules]

    return parsed


def _loads_once(load):
    known = {}

    def loaded(file_):
        if not hasattr(file_, "read"):
            with Path(file_).open(encoding="utf-8") as stream:
                return loaded(stream)
        begin, text = file_.tell(), file_.read()
        if text not in known:
            file_.seek(begin)
            known[text] = pickle.dumps(load(file_))
        return pickle.loads(known[text])  # faster than copy.deepcopy

    return loaded


def _listed_once(make):
    known = {}

    def listed(repo, config_name, overrides, prepend_hydra, skip_missing):
        sources = _contents(repo)
        if sources is None:
            return make(repo, config_name, overrides, prepend_hydra, skip_missing)
        typed = {k: v for k, v in vars(overrides).items() if k != "config_overrides"}
        key = (sources, config_name, repr(typed), prepend_hydra, skip_missing)
        if key not in known:
            found, tree = make(repo, config_name, overrides, prepend_hydra, skip_missing)
            known[key] = pickle.dumps((found, typed))  # `typed` has been changed with `overrides`
            return found, tree
        found, used = pickle.loads(known[key])
        vars(overrides).update(used)
        return found, None

    return listed


def _merged_once(merge):
    known = {}

    def merged(self, defaults, repo):
        sources = _contents(repo)
        if sources is None:
            return merge(self, defaults, repo)
        key = (sources, repr(defaults))
        if key not in known:
            known[key] = pickle.dumps(merge(self, defaults, repo))
        return pickle.loads(known[key])

    return merged


def _contents(repo):
    """Return where configurations come from, with the contents of a user's folder.

    None if that folder holds what is no plain file, or too much.
    """
    found = []
    for source in repo.get_sources():
        found.append((source.scheme(), source.path, frozenset(getattr(source, "brokers", ()))))
        if source.scheme() == "file" and source.path != CONFIGS:
            for path in islice(Path(source.path).rglob("*"), MAX_FILES + 1):
                plain = path.is_dir() or (path.is_file() and path.stat().st_size <= MAX_BYTES)
                if path.is_symlink() or not plain or len(found) > MAX_FILES:
                    return None
                found.append((str(path), None if path.is_dir() else path.read_bytes()))
    return tuple(found)
