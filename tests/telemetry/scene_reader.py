"""A viewer of foxglove.SceneUpdate messages in a few lines: it knows the schema and nothing of kinetix-dist.

Entities are stored by topic and id, as the schema says: an update deletes, then adds or replaces. The picture is what
is seen from above (z towards the viewer), higher primitives over lower ones.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image, ImageDraw

SCHEMA = "foxglove.SceneUpdate"
MATCHING_ID, ALL = 0, 1
LINE_LOOP = 1
OVERSAMPLED = 4  # pixels of the drawing to one of the picture
Entities = dict[tuple[str, str], Any]


def scene_updates(path: Path) -> list[tuple[str, int, Any]]:
    """(topic, log time in ns, message) of all scene updates, decoded by the schema that the file carries."""
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        return [
            (channel.topic, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
            if schema is not None and schema.name == SCHEMA
        ]


def apply(entities: Entities, topic: str, update: Any) -> None:
    """Deletes, then adds or replaces entities of a topic."""
    for deletion in update.deletions:
        for key, entity in list(entities.items()):
            is_meant = deletion.type == ALL or (deletion.type == MATCHING_ID and deletion.id == key[1])
            if key[0] == topic and is_meant and _ns(entity.timestamp) <= _ns(deletion.timestamp):
                del entities[key]
    for entity in update.entities:
        entities[topic, entity.id] = entity


def picture(
    entities: Entities, background: tuple[int, int, int], view: tuple[float, ...], pixels_per_metre: float
) -> np.ndarray:
    """uint8 [height, width, 3] of a part of the plane: view is lowest x and y, highest x and y, m."""
    width, height = (round((view[2 + axis] - view[axis]) * pixels_per_metre) for axis in (0, 1))
    image = Image.new("RGB", (width * OVERSAMPLED, height * OVERSAMPLED), background)
    canvas, scale = ImageDraw.Draw(image), pixels_per_metre * OVERSAMPLED
    shown = [(shape, "triangles") for entity in entities.values() for shape in entity.triangles]
    shown += [(shape, "lines") for entity in entities.values() for shape in entity.lines]
    for shape, kind in sorted(shown, key=lambda item: item[0].pose.position.z):
        points = _placed(shape)
        pixels = np.stack([points[:, 0] - view[0], view[3] - points[:, 1]], axis=-1) * scale
        colour = tuple(round(255 * value) for value in (shape.color.r, shape.color.g, shape.color.b))
        if kind == "triangles":
            order = list(shape.indices) or list(range(len(pixels)))
            for first in range(0, len(order), 3):
                canvas.polygon([tuple(pixels[k]) for k in order[first : first + 3]], fill=colour)
        elif len(pixels):
            ring = [*pixels, *pixels[:1]] if shape.type == LINE_LOOP else list(pixels)
            assert shape.scale_invariant  # thickness in pixels
            canvas.line([tuple(point) for point in ring], fill=colour, width=round(shape.thickness * OVERSAMPLED))
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))


def _placed(shape: Any) -> np.ndarray:
    """[k, 2] m: points of a primitive, turned about z by its quaternion and moved by its position."""
    pose = shape.pose
    assert pose.orientation.x == pose.orientation.y == 0.0  # a plane world turns about z alone
    turn = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
    points = np.array([[point.x, point.y] for point in shape.points]).reshape(-1, 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return points @ rotation.T + [pose.position.x, pose.position.y]


def _ns(time: Any) -> int:
    """Nanoseconds of a timestamp; the mcap library decodes it as a message."""
    return time.seconds * 1_000_000_000 + time.nanos
