"""What the demo pair is asked in its evaluation, fixed before it was trained.

Classes, with the kinds of the synthetic city that each one names; words that no training list holds; things that no
street of the city has.
"""

CLASSES: dict[str, tuple[str, ...]] = {
    "sky": ("sky",),
    "road": ("road",),
    "sidewalk": ("sidewalk",),
    "grass": ("terrain",),
    "building": ("house", "shop"),
    "wall": ("wall",),
    "fence": ("fence",),
    "tree": ("tree",),
    "bush": ("bush", "hedge"),
    "street lamp": ("street lamp",),
    "traffic sign": ("stop sign", "yield sign", "parking sign", "speed limit sign"),
    "traffic cone": ("traffic cone",),
    "barrier": ("barrier",),
    "car": ("sedan", "estate car", "hatchback", "suv", "taxi"),
    "van": ("van",),
    "truck": ("box truck", "flatbed truck", "cement truck", "garbage truck", "tanker truck", "dump truck"),
    "bus": ("bus",),
    "trailer": ("trailer",),
    "construction vehicle": ("excavator", "wheel loader"),
    "motorcycle": ("motorcycle",),
    "bicycle": ("bicycle",),
    "pedestrian": ("pedestrian",),
}
"""Prompts, and the kinds of things they name. Other kinds are not judged: bins, benches, signals, sheds, squares."""

NEVER_RENDERED: tuple[tuple[str, str], ...] = (("red", "truck"), ("green", "car"), ("blue", "van"))
"""Colours and classes whose pairs no training picture shows and no training phrase names."""

UNSEEN_SYNONYMS: dict[str, str] = {
    "lorries": "truck", "semi trailer truck": "truck", "pickup truck": "truck", "limousine": "car", "coupe": "car",
    "convertible": "car", "motor car": "car", "minibus": "bus", "omnibus": "bus", "camper": "van",
    "scooter": "motorcycle", "motorbikes": "motorcycle", "tricycle": "bicycle", "cycling": "bicycle",
    "child": "pedestrian", "walker": "pedestrian", "boy": "pedestrian", "avenue": "road", "boulevard": "road",
    "lane": "road", "pavement": "sidewalk", "pathway": "sidewalk", "villa": "building", "cottage": "building",
    "skyscraper": "building", "tower": "building", "shrubbery": "bush", "maple": "tree", "conifer": "tree",
    "forest": "tree", "railing": "fence", "palisade": "fence", "lantern": "street lamp", "streetlight": "street lamp",
    "signpost": "traffic sign", "billboard": "traffic sign", "barricade": "barrier", "pasture": "grass",
    "field": "grass", "heaven": "sky", "caravan": "trailer", "crane": "construction vehicle", "stone wall": "wall",
    "pylon": "traffic cone",
}  # fmt: skip
"""Words, none of them in a training list, and the class each should be nearest to."""

UNSEEN_ABSENT: tuple[str, ...] = (
    "dinosaur", "shark", "birthday cake", "guitar", "volcano", "penguin", "sushi", "pyramid", "saxophone", "spaceship",
    "igloo", "jellyfish", "hamburger", "parachute", "camel", "mushroom", "pumpkin", "crocodile", "wedding dress",
    "bowling ball",
)  # fmt: skip
"""Things that are not there and were not trained as such."""
