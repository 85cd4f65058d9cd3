"""The long-term memory of a city: occupancy logits in geographic tiles, written by a fleet, read by every car.

city = TileMap.create("city.tiles", class_names)
city.write(logits, mask, T_world_ego, spec, stamp=t, agent="car-7", log="2026-11-22a")
prior = city.read(T_world_ego, spec, exclude_logs=["2026-11-22a"])
"""

from openvocab_occ.memory.tile_map import TileMap as TileMap
from openvocab_occ.memory.tile_map import Written as Written
from openvocab_occ.memory.window import Prior as Prior
from openvocab_occ.memory.writer import Writer as Writer
