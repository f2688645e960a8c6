"""`python -m vatsloc`."""

from vatsloc.cli import main

main()
