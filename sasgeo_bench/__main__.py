# SPDX-License-Identifier: Apache-2.0
"""`python -m sasgeo_bench` is the program `sasgeo-bench`."""

from sasgeo_bench.cli import main

if __name__ == "__main__":
    main()
