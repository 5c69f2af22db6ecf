"""The names of liftcore.files, and where they live."""

from liftcore.features.encoders.encode import read_image as read_image
from liftcore.io.files import check_output as check_output
from liftcore.io.files import is_zip as is_zip
from liftcore.io.files import visible_files as visible_files
from liftcore.io.files import whole_file as whole_file
from liftcore.io.files import writing as writing
from liftcore.io.json_file import finite as finite
from liftcore.io.kinds import identify as identify
from liftcore.io.kinds import page_table as page_table
from liftcore.io.kinds import wrong_kind as wrong_kind
from liftcore.io.photo_zip import in_camera_orientation as in_camera_orientation
from liftcore.io.photo_zip import photo_index as photo_index
from liftcore.io.safetensors_file import with_metadata as with_metadata
from liftcore.scene.views import cameras_of_views as cameras_of_views
from liftcore.scene.views import require_pairs as require_pairs

__all__: list[str]
