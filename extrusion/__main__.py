"""``python -m extrusion``, the same as the command ``extrusion``."""

from extrusion.cli import main

main()
