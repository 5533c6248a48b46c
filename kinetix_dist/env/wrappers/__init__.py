"""The environment behind other packages' interfaces: gymnasium, gymnax, and the names of the public Kinetix package.

They need the packages whose interfaces they have, the extra `wrappers`. Nothing else imports these modules.
"""

from __future__ import annotations

import importlib.util

for _package in ("gymnasium", "gymnax"):
    if importlib.util.find_spec(_package) is None:
        raise ImportError(f"{_package} is not installed, which wrappers need: pip install 'kinetix-dist[wrappers]'")
