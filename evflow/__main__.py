"""`python -m evflow`, the same as `evflow`."""

from evflow.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
