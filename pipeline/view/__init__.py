"""The viewer: what the pipeline sees and estimates, in Rerun, as a file and live.

The scene is drawn in the target's docking port frame (z out of the target, y up), so the target stands still
and the chaser comes in.  No other package imports Rerun.
"""

from pipeline.view.streams import has_display, web_url
from pipeline.view.viewer import Viewer, ViewMode

__all__ = ["ViewMode", "Viewer", "has_display", "web_url"]
