"""`python -m evflow`, the same as `evflow`."""

from evflow.cli import run

if __name__ == "__main__":
    run()
