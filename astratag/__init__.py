"""The AstraTag marker: geometry, codes, artwork, camera model, detection and pose.  Knows no transport."""

from astratag.annotate import annotate
from astratag.camera import Camera
from astratag.detection import Detection, LayerDetection, PlanarPose
from astratag.detector import Detector, MarkerSpec
from astratag.dictionary import Dictionary, load_dictionary, write_dictionary
from astratag.surface import Cylinder, Flat, Surface
from astratag.tracker import Tracker

__all__ = [
    "Camera",
    "Cylinder",
    "Detection",
    "Detector",
    "Dictionary",
    "Flat",
    "LayerDetection",
    "MarkerSpec",
    "PlanarPose",
    "Surface",
    "Tracker",
    "annotate",
    "load_dictionary",
    "write_dictionary",
]
