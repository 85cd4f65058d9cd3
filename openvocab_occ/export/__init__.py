"""Maps to files that others read."""

from openvocab_occ.export.views import Lookout as Lookout
from openvocab_occ.export.views import ViewBundle as ViewBundle
from openvocab_occ.export.views import ViewOptions as ViewOptions
from openvocab_occ.export.views import export_views as export_views
