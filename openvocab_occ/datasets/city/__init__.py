"""A made-up town, driven many times, whose truth is known exactly. All of it is synthetic.

    from openvocab_occ.datasets.city import City

    city = City(seed=7)
    drive = city.traversal(route=0, number=0, condition="clear")   # 40 keyframes at 2 Hz
    for name, camera, time in drive.cameras(index=8, size=(704, 256)):
        picture = drive.render(camera, time)
    picture = city.render(camera, time, condition="night")         # the same, of route 0 and traversal 0

A `Rendering` holds `.image` (RGB), `.depth` (true z-depth, 0 for the sky), `.semantic` (Occ3D class, `LABELS`; 255 for
the sky), `.instance` (number of the thing, 0 for the sky) and `.part` (`PART_NAMES`; 255 for the sky). What a number
stands for is in `drive.attributes()`: class, kind ("box truck"), colour name and parts of each instance. Cameras may
stand anywhere. Everything is drawn from seeds: the same call gives the same picture on the same machine.

`keyframes` makes LiDAR sweeps, boxes and Occ3D labels, `oracle.perceive` stands in for a perception network, and
`writer.write_city` writes it all as a nuScenes tree. `load_sequence("city", ...)` gives plain frames.
"""

from openvocab_occ.datasets.city.city import Attributes as Attributes
from openvocab_occ.datasets.city.city import City as City
from openvocab_occ.datasets.city.render import Rendering as Rendering
from openvocab_occ.datasets.city.surfaces import PAINTS as PAINTS
from openvocab_occ.datasets.city.surfaces import PART_NAMES as PART_NAMES
from openvocab_occ.datasets.city.surfaces import SKY as SKY
from openvocab_occ.datasets.city.things import LABELS as LABELS
from openvocab_occ.datasets.city.traversal import MAX_FRAMES as MAX_FRAMES
from openvocab_occ.datasets.city.traversal import Traversal as Traversal
from openvocab_occ.datasets.city.weather import CONDITIONS as CONDITIONS
