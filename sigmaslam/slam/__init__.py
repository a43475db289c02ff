"""The tracker: matching, mapping, loops, relocalisation, and bodies before a camera at rest."""
