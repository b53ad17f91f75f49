"""`python -m sitl_stub`: the same as the command `sitl-stub`."""

from sitl_stub.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
