"""Templates compiled once for all applications of the tests of the pages."""

import pytest
from flask.templating import Environment


@pytest.fixture(scope="package", autouse=True)
def _templates_compiled_once():
    compiled, compile_ = {}, Environment.compile

    def once(self, source, name=None, filename=None, raw=False, defer_init=False):
        key = source, name, filename, raw, defer_init
        if key not in compiled:
            compiled[key] = compile_(self, *key)
        return compiled[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Environment, "compile", once)
        yield
