"""The environment behind other packages' interfaces: gymnasium, gymnax, and the names of the public Kinetix package.

Each needs the package whose interface it has: `pip install kinetix-dist[wrappers]`. Nothing else imports these modules.
"""
