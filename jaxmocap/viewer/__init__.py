"""The HTML player: one self-contained file that shows a motion, or a motion and its decoded copy with the error."""

from .player import Track as Track
from .player import motion_player as motion_player
from .player import player_html as player_html
