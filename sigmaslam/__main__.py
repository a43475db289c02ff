"""`python -m sigmaslam`."""

from sigmaslam.cli import main

main()
