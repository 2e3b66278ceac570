"""The AstraTag marker: geometry, codes, artwork, camera model, detection and pose.  Knows no transport."""
