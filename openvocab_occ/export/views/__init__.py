"""View bundles for people, programs and vision-language models."""

from openvocab_occ.export.views.bundle import ViewBundle as ViewBundle
from openvocab_occ.export.views.bundle import ViewOptions as ViewOptions
from openvocab_occ.export.views.bundle import export_views as export_views
from openvocab_occ.export.views.lookout import Lookout as Lookout
