"""A furnished room: four walls with a group of furniture at each, and a rug with a low table in the centre."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from worlds import furniture as fur
from worlds import textures as tex
from worlds import things
from worlds.cameras import walk
from worlds.light import Body, Lamp, Lighting, Part, Scene, bake_all
from worlds.shapes import Sheet, rotation_from_axes, spin

VIEWS = 72
FOCAL_35MM = 26  # 35 mm equivalent of a phone's wide camera
POINTS = 220_000
HEIGHT = 2.6
SIDES = "NESW"
RUGS = [
    ["#8e2a2e", "#e8dcc0", "#1f2f5a", "#c9a227", "#3f6b4f"],
    ["#27406b", "#e5d9bd", "#9c3a33", "#d0a94a", "#5b7f94"],
    ["#3f5f49", "#efe3c8", "#8a5a2b", "#d6b25e", "#702f2f"],
]


class Room:
    """Bodies gathered in a room of half extents `half` [2] about the origin, the floor at z = 0."""

    def __init__(self, half: np.ndarray) -> None:
        self.half = half
        self.bodies: list[Body] = []

    def stand(
        self, body: Body, wall: int, along: float, out: float, up: float = 0.0, turn: float = 0.0, on: str = "floor"
    ) -> None:
        """Places a body `out` metres from the wall (0 to 3: at +y, +x, -y, -x), facing into the room, `along` metres to
        the right of the wall's centre as seen from inside. turn: additional rotation in degrees. on: name of the body
        under it, or "wall" if it hangs there."""
        yaw = -90.0 * wall
        reach = self.half[1] if wall % 2 == 0 else self.half[0]
        body = replace(body, hangs_on=f"wall {SIDES[wall]}") if on == "wall" else replace(body, on=on)
        self.bodies.append(body.placed(yaw + turn, spin(yaw) @ np.array([along, reach - out, up])))


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene. The seed selects dimensions, positions, colours, materials and the group at each wall.

    light_samples: rays per texel of the light maps, for each lamp and for ambient light; fewer are faster and noisier.
    """
    rng = np.random.default_rng((seed, 20))
    half = np.array([rng.uniform(2.55, 2.8), rng.uniform(2.25, 2.45)])
    room = Room(half)
    room.bodies += _shell(rng, half)
    walls = (np.array([0, 1, 2, 3]) + rng.integers(4)) % 4
    side = 1 if rng.random() < 0.5 else -1  # the television is to the right (1) or to the left (-1) of the sofa
    sitting, watching, dining, working = walls[::side].tolist()
    _sitting(rng, room, sitting, side)
    _watching(rng, room, watching)
    _dining(rng, room, dining)
    _working(rng, room, working)
    lighting = Lighting(
        [
            Lamp(np.array([-0.5 * half[0], 0.35 * half[1], 2.45]), 0.30, np.array([1.0, 0.94, 0.85]) * 3.4),
            Lamp(np.array([0.55 * half[0], -0.40 * half[1], 2.40]), 0.30, np.array([0.95, 0.97, 1.0]) * 3.0),
        ],
        np.array([0.44, 0.45, 0.47]),
    )
    bake_all(room.bodies, lighting, rng, max(2, light_samples // 2))
    asked = [body.name for body in room.bodies if body.category in ("sofa", "bookcase", "television")]
    return Scene(room.bodies, lighting, partial(walk, focal_35mm=FOCAL_35MM, half=half), [*asked, "elephant"])


def _shell(rng: np.random.Generator, half: np.ndarray) -> list[Body]:
    """Floor, ceiling and four walls. Each wall has its own paint."""
    grounds = rng.permutation(["#b9cdc4", "#cfc3ae", "#c2c7d8", "#d8c3c0", "#c9d4b6"])
    width, depth = (2 * half).tolist()

    def paint(kind: int, across: float) -> np.ndarray:
        h, w = int(280 * HEIGHT), int(280 * across)
        leaves = ["#8fa596", "#a3957a", "#e6e0d2", "#7b8a97", "#b98a5e"]
        if kind == 0:
            return tex.bricks(rng, h, w, str(rng.choice(["#b0623f", "#a87a5c", "#c8c0b4"])))
        if kind == 1:
            return tex.plaster(rng, h, w, str(grounds[0]))
        return tex.wallpaper(rng, h, w, str(grounds[kind - 1]), leaves)

    kinds = rng.permutation(4)
    faces = [([1, 0, 0], [0, -1, 0], [0, half[1]], width), ([0, -1, 0], [-1, 0, 0], [half[0], 0], depth),
             ([-1, 0, 0], [0, 1, 0], [0, -half[1]], width), ([0, 1, 0], [1, 0, 0], [-half[0], 0], depth)]  # fmt: skip
    bodies = []
    for side, kind, (along, normal, place, across) in zip(SIDES, kinds, faces, strict=True):
        sheet = Sheet(across, HEIGHT, rotation_from_axes(along, normal), np.array([*place, HEIGHT / 2]))
        part = Part(sheet, paint(int(kind), across), 0.0, (44, 72), False)
        bodies.append(Body(f"wall {side}", ["room wall"], [part], is_stuff=True, kind="wall"))
    light, dark = fur.WOODS[str(rng.choice(["oak", "pine", "walnut"]))]
    boards = tex.wood(rng, int(260 * depth), int(260 * width), 22, light, dark)
    floor = Part(Sheet(width, depth, np.eye(3), np.zeros(3)), boards, 0.0, (72, 84), False)
    above = rotation_from_axes([1, 0, 0], [0, 0, -1])
    white = tex.plaster(rng, 500, 560, "#dedad0")
    ceiling = Part(Sheet(width, depth, above, np.array([0, 0, HEIGHT])), white, 0.0, (24, 28), False)
    return [
        Body("floor", ["wooden floor"], [floor], is_stuff=True),
        Body("ceiling", ["white ceiling"], [ceiling], is_stuff=True),
        *bodies,
    ]


def _hang(rng: np.random.Generator, room: Room, wall: int, kind: str, along: float, width: float) -> None:
    """A framed picture: one of tex.SKIES, or abstract."""
    frame, landscape = str(rng.choice(list(fur.WOODS))), kind in tex.SKIES
    art = (
        tex.landscape(rng, 480, 680, *tex.SKIES[kind], kind.upper())
        if landscape
        else tex.mosaic(rng, 620, 520, tex.ABSTRACT)
    )
    hung = fur.picture(rng, f"{kind} picture", art, width, frame)
    room.stand(hung, wall, along, 0.0, rng.uniform(1.5, 1.62), on="wall")


def _sitting(rng: np.random.Generator, room: Room, wall: int, side: int) -> None:
    """Sofa with cushions, lamp and plant beside it, a low table on a rug before it, an armchair on one side (±1)."""
    cloth, other = rng.permutation(["grey", "blue", "green", "beige"])[:2]
    width = rng.uniform(1.75, 2.0)
    sofa = fur.sofa(rng, f"{cloth} sofa", width, cloth, 2 + int(width > 1.9))
    room.stand(sofa, wall, 0, 0.47)
    colors = rng.permutation(["red", "yellow", "purple", "white"])[:2]
    for color, along in zip(colors, (-0.45, 0.42), strict=True):
        room.stand(fur.cushion(rng, f"{color} cushion", things.COLORS[color]), wall, along, 0.42, 0.48, on=sofa.name)
    room.stand(things.teddy(rng).placed(0, np.zeros(3), 1.5), wall, rng.uniform(-0.1, 0.1), 0.50, 0.49, on=sofa.name)
    shade = str(rng.choice(["#c98a4a", "#c9b48a", "#a8453a"]))
    room.stand(fur.floor_lamp(rng, "floor lamp", shade), wall, 1.35 * side, 0.36)
    room.stand(fur.plant(rng, "big plant"), wall, -1.42 * side, 0.45, turn=rng.uniform(0, 360))
    _hang(rng, room, wall, "lake", rng.uniform(-0.2, 0.2), rng.uniform(0.9, 1.1))
    out = 1.62
    rug = fur.rug(rng, "oriental rug", 2.2, 1.5, RUGS[int(rng.integers(len(RUGS)))])
    room.stand(rug, wall, 0, out, turn=rng.uniform(-4, 4))
    low = fur.table(rng, "coffee table", (1.05, 0.58, 0.42), str(rng.choice(["oak", "walnut"])), ["low table"], True)
    room.stand(low, wall, 0.0, out, 0.012, on=rug.name)
    top = 0.432
    bowl = things.bowl(rng, "bowl of fruit", things.COLORS["blue"], ["orange", "red apple", "green apple", "lemon"])
    room.stand(bowl.placed(0, np.zeros(3), 1.3), wall, rng.uniform(-0.35, -0.2), out, top, on=low.name)
    book = things.book(rng, str(rng.choice(list(things.BOOKS))))
    room.stand(book.placed(0, np.zeros(3), 1.2), wall, 0.30, out + 0.05, top, rng.uniform(-40, 40), low.name)
    chair = fur.sofa(rng, f"{other} armchair", 0.95, other, 1)
    beside = (room.half[wall % 2] - 1.15) * side  # keeps clear of the group at the next wall
    room.stand(chair, wall, beside, 1.5, turn=-75 * side + rng.uniform(-12, 12))


def _watching(rng: np.random.Generator, room: Room, wall: int) -> None:
    """Television on a cabinet, a speaker, clock, door, bin."""
    kind = str(rng.choice(["walnut", "white"]))
    stand = fur.cabinet(rng, "tv stand", kind, (1.4, 0.42, 0.48), ["tv bench", "low cabinet"], 3)
    room.stand(stand, wall, -0.35, 0.23)
    room.stand(fur.television(rng, "television"), wall, -0.35, 0.24, 0.48, on=stand.name)
    room.stand(fur.speaker(rng, "speaker"), wall, 0.52, 0.22)
    clock = things.clock(rng).placed(0, np.zeros(3), 1.25)
    room.stand(clock, wall, -0.35 + rng.uniform(-0.2, 0.2), 0.01, 1.72, on="wall")
    room.stand(fur.door(rng, "door", "white" if kind == "walnut" else "pine"), wall, 1.30, 0.0, on="wall")
    paint = tex.glaze(rng, 200, 300, str(rng.choice(["#5b6f82", "#7b8a5a", "#8a4a4a"])), ["#222222", "#dddddd"], 200)
    room.stand(fur.turned("waste bin", paint), wall, -1.75, 0.35)


def _dining(rng: np.random.Generator, room: Room, wall: int) -> None:
    """Table laid for a meal, four chairs, cartons in the corner, a ball."""
    kind, cloth = str(rng.choice(["oak", "pine"])), str(rng.choice(["red", "blue", "green"]))
    out, top = 0.98, 0.745
    name = "dining table"
    room.stand(fur.table(rng, name, (1.35, 0.8, top), kind, ["wooden table"]), wall, -0.25, out)
    for k, (along, away) in enumerate([(-0.58, 0.56), (0.10, 0.56), (-0.56, -0.50), (0.08, -0.50)]):
        turn = rng.uniform(-8, 8) + (180 if away > 0 else 0)
        chair = fur.chair(rng, f"{cloth} chair {k + 1}", kind, cloth)
        room.stand(chair, wall, along + rng.uniform(-0.03, 0.03), out + away, turn=turn)
    room.stand(things.vase(rng), wall, -0.25, out, top, on=name)
    room.stand(things.plate(rng, "#a8302a"), wall, -0.58, out + 0.20, top, on=name)
    room.stand(things.carton(rng), wall, 0.12, out - 0.12, top, rng.uniform(-40, 40), name)
    room.stand(things.mug(rng, "red"), wall, 0.16, out + 0.2, top, rng.uniform(0, 360), name)
    room.stand(things.bottle(rng, "green bottle", "#2c5a35"), wall, -0.66, out - 0.14, top, on=name)
    _hang(rng, room, wall, "desert", -0.25, rng.uniform(0.85, 1.1))
    low = rng.uniform(0.30, 0.36)
    room.stand(fur.cardboard(rng, "cardboard box", (0.55, 0.42, low)), wall, 1.35, 0.32, turn=rng.uniform(-12, 12))
    small = fur.cardboard(rng, "small cardboard box", (0.34, 0.28, 0.22))
    room.stand(small, wall, 1.33, 0.32, low, rng.uniform(-30, 30), "cardboard box")
    room.stand(things.ball(rng, "basketball", 0.12), wall, 1.0, 0.75)


def _working(rng: np.random.Generator, room: Room, wall: int) -> None:
    """Desk with a laptop, lamp and mug, a stool before it, a bookcase beside it."""
    kind = str(rng.choice(["white", "oak", "walnut"]))
    top = 0.74
    room.stand(fur.table(rng, "desk", (1.2, 0.6, top), kind, ["writing desk"]), wall, -0.75, 0.34)
    room.stand(fur.laptop(rng, "laptop"), wall, -0.75, 0.36, top, rng.uniform(-15, 15), "desk")
    color = str(rng.choice(["red", "yellow", "green"]))
    lamp = fur.desk_lamp(rng, f"{color} desk lamp", things.COLORS[color])
    room.stand(lamp, wall, -1.22, 0.24, top, rng.uniform(-30, 30), "desk")
    room.stand(things.mug(rng, "blue"), wall, -0.38, 0.42, top, rng.uniform(0, 360), "desk")
    room.stand(things.cactus(rng).placed(0, np.zeros(3), 1.3), wall, -0.28, 0.2, top, on="desk")
    room.stand(fur.turned("wooden stool", np.ascontiguousarray(fur.wood(rng, "pine"))), wall, -0.75, 0.95)
    room.stand(fur.bookcase(rng, "bookcase", kind, 0.9, rng.uniform(1.7, 2.0)), wall, 0.75, 0.17)
    _hang(rng, room, wall, "abstract", -0.75, rng.uniform(0.5, 0.62))
    room.stand(things.ball(rng, "soccer ball", 0.11), wall, 1.45, 0.45)
