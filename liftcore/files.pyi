"""The names of liftcore.files, and where they live."""

from liftcore.features.encoders.encode import read_image as read_image
from liftcore.io.json_file import finite as finite
from liftcore.io.kinds import identify as identify
from liftcore.io.kinds import wrong_kind as wrong_kind
from liftcore.io.outputs import check_output as check_output
from liftcore.io.outputs import writing as writing
from liftcore.io.remote import is_remote as is_remote
from liftcore.io.remote import local_path as local_path

__all__: list[str]
