"""Parse one depth frame into a posterior over scenes."""

from bayes3d_ros.inference.settings import ParserSettings
from bayes3d_ros.model.objects import Library
from bayes3d_ros.model.observation import DepthFrame
from bayes3d_ros.model.posterior import ScenePosterior


class SceneParser:
    """Holds a library and compiled code; keeps no state between frames."""

    def __init__(self, library: Library, settings: ParserSettings = ParserSettings()) -> None:
        self.library, self.settings = library, settings

    def warm_up(self, width: int, height: int) -> None:
        """Compile for images of this size (values of the intrinsics do not matter)."""
        raise NotImplementedError

    def parse(self, frame: DepthFrame) -> ScenePosterior:
        """The posterior given one frame. Raises ParseError with one clear line when there is none."""
        raise NotImplementedError
