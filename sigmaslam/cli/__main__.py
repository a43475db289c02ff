"""`python -m sigmaslam.cli`."""

from sigmaslam.cli import main

main()
