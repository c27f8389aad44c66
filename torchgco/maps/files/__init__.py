"""Maps from files: docs/maps.md lists the formats.

Files of others are data only: no pickles, no code, no memory taken before sizes are checked. A wrong, cut or hostile
file is one InputError with its name.
"""

from torchgco.maps.files.arrays import read_task as read_task
from torchgco.maps.files.read import FORMATS as FORMATS
from torchgco.maps.files.read import read as read
from torchgco.maps.files.read import usual_outside as usual_outside
