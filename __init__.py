"""Read only where Python is started in the folder that holds a clone of this repository called `magtensor`.

Such a clone would stand for the package, and be an empty one. It hands over to the package that is installed.
"""

import importlib.util
import os
import sys


def _hand_over(name: str) -> None:
    here = os.path.dirname(os.path.abspath(__file__))
    elsewhere = [p for p in sys.path if os.path.abspath(p) != os.path.dirname(here)]
    for finder in sys.meta_path:
        spec = finder.find_spec(name, elsewhere)
        if spec is not None and spec.loader is not None and spec.origin not in (None, __file__):
            sys.modules[name] = module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            return
    raise ImportError(
        f"{here} is a clone of {name}, which is not installed here: run `make demo`, or `pip install -e {here}`"
    )


if __name__ == "magtensor":
    _hand_over(__name__)
