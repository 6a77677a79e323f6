"""A plugin of pytest: imports one module from the source that the environment holds."""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
from pathlib import Path


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Finds the one changed module, and nothing else."""

    def __init__(self, name: str, source: str) -> None:
        self._name, self._source = name, source

    def find_spec(self, fullname, path=None, target=None):
        if fullname != self._name:
            return None
        return importlib.util.spec_from_loader(fullname, self, origin=self.get_filename(fullname))

    def get_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split(".")).with_suffix(".py").resolve())

    def get_data(self, path: str) -> bytes:
        return self._source.encode()


sys.meta_path.insert(0, _Finder(os.environ["MUTATED_MODULE"], os.environ["MUTATED_SOURCE"]))
