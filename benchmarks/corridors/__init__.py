"""The filter on pictures: how near it comes to what the corners that the detector measures allow."""
