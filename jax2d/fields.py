"""Declarations of the arrays of worlds: dimensions, type, unit, meaning and limits of each field, stated once.

    class Joints:
        active: Array = array("J", bool, "a joint of an inactive shape does nothing")
        motor_power: Array = array("J", float, "...", unit="...", at_least=0, only_where="motor_on")

`scene.py` and `level.py` of the training system declare their records this way. Checks, kernel tables, packing,
builders, moving slots and empty worlds are derived from the declarations (`fields_of`).

Dimensions are letters of `Capacity.sizes` (n shapes, P polygons, V vertices, C circles, J joints, T thrusters,
S springs, K contact slots; E shapes and R contact slots of a capacity with extended shapes, else none) or digits. The
first one names the slots of a field.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Array = Any  # jax.Array or numpy.ndarray: fields are traced, stored and compared alike
Record = TypeVar("Record", bound="DataclassInstance")

_KEY = "array"
_PART = "part"
_DTYPES = {bool: np.bool_, int: np.int32, float: np.float32}
SLOTS = "nPCJTS"  # letters of which a world has slots that can be active or not


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """The declaration of one array of a record."""

    path: tuple[str, ...]  # where it stands: ("joints", "motor_power")
    dims: tuple[str, ...]  # letters of `Capacity.sizes`, or digits
    kind: type  # bool, int or float
    meaning: str
    unit: str = ""
    empty: Any = 0  # in slots that are not in use; rows of a longer field, of which the last is repeated
    at_least: float | None = None  # limits of active slots
    at_most: float | None = None
    above: float | None = None
    only_where: str | None = None  # a bool field of the same record where the limits hold
    refers_to: str | None = None  # "n": the numbers are those of shapes
    bits: int | None = None  # of an int in a packed word of the kernel
    stepped: bool = True  # read by a step
    may_be_none: bool = False  # callers may leave it out: zeros

    @property
    def name(self) -> str:
        """Path with dots: joints.motor_power."""
        return ".".join(self.path)

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        return tuple(sizes[letter] for letter in self.dims)

    def get(self, record: Any) -> Any:
        return functools.reduce(getattr, self.path, record)

    def dtype(self, float_dtype: Any = np.float32) -> np.dtype:
        return np.dtype(float_dtype if self.kind is float else _DTYPES[self.kind])


def array(dims: str, kind: type, meaning: str, **facts: Any) -> Any:
    """Declares a field of a record; `facts` are those of `Field`."""
    declared = {"dims": tuple(dims.split()), "kind": kind, "meaning": meaning, **facts}
    if facts.get("may_be_none"):
        return dataclasses.field(metadata={_KEY: declared}, default=None)
    return dataclasses.field(metadata={_KEY: declared})


def part(kind: type) -> Any:
    """Declares a field that is a record itself."""
    return dataclasses.field(metadata={_PART: kind})


@functools.cache
def fields_of(kind: type) -> tuple[Field, ...]:
    """Returns all arrays of a record and its parts, in the order declared."""
    found: list[Field] = []
    for declared in dataclasses.fields(kind):
        if _PART in declared.metadata:
            inner = fields_of(declared.metadata[_PART])
            found += [dataclasses.replace(field, path=(declared.name, *field.path)) for field in inner]
        elif _KEY in declared.metadata:
            found.append(Field(path=(declared.name,), **declared.metadata[_KEY]))
        else:
            raise TypeError(f"{kind.__name__}.{declared.name} is not declared with array() or part()")
    return tuple(found)


def field_of(kind: type, name: str) -> Field:
    """The field with this dotted name."""
    return next(field for field in fields_of(kind) if field.name == name)


def make(kind: type[Record], value: Callable[[Field], Any], _path: tuple[str, ...] = ()) -> Record:
    """A record of which every array is `value(field)`."""
    values = {}
    for declared in dataclasses.fields(kind):
        path = (*_path, declared.name)
        if _PART in declared.metadata:
            values[declared.name] = make(declared.metadata[_PART], value, path)
        else:
            values[declared.name] = value(Field(path=path, **declared.metadata[_KEY]))
    return kind(**values)


def empty(kind: type[Record], sizes: Mapping[str, int]) -> Record:
    """A record of numpy arrays with nothing in it."""
    return make(kind, lambda field: _empty_array(field, field.shape(sizes)))


def as_dict(record: Any) -> dict[str, Array]:
    """The arrays of a record by their dotted names."""
    return {field.name: field.get(record) for field in fields_of(type(record))}


def from_dict(kind: type[Record], arrays: Mapping[str, Array]) -> Record:
    """The inverse of `as_dict`; raises KeyError for a field that is missing."""
    return make(kind, lambda field: arrays[field.name])


def with_fields(record: Record, arrays: Mapping[str, Array]) -> Record:
    """The record with some fields, by dotted name, replaced. Raises ValueError for a name that is none."""
    known = as_dict(record)
    if unknown := sorted(set(arrays) - set(known)):
        raise ValueError(f"{type(record).__name__} has no field {unknown[0]!r}; fields are {', '.join(known)}")
    return from_dict(type(record), known | dict(arrays))


def broadcast(record: Record, batch: tuple[int, ...]) -> Record:
    """A batch of records that are all alike."""
    return jax.tree.map(lambda x: np.broadcast_to(x, (*batch, *np.shape(x))), record)


def replace(record: Record, **changes: Any) -> Record:
    """`dataclasses.replace` in which a dict stands for changes of a part: replace(scene, joints={"active": x})."""
    changes = {
        name: replace(getattr(record, name), **change) if isinstance(change, dict) else change
        for name, change in changes.items()
    }
    return dataclasses.replace(record, **changes)


def _empty_array(field: Field, shape: tuple[int, ...]) -> np.ndarray:
    rows = np.asarray(field.empty)
    if rows.ndim == 2:  # of the second dimension
        rows = rows[np.minimum(np.arange(shape[1]), len(rows) - 1)]
    return np.broadcast_to(rows, shape).astype(field.dtype()).copy()


def tree_like(kind: type[Record], sizes: Mapping[str, int], float_dtype: Any, batch: tuple[int, ...]) -> Record:
    """The record as shapes and types alone."""
    return make(kind, lambda field: jax.ShapeDtypeStruct((*batch, *field.shape(sizes)), field.dtype(float_dtype)))


def num_elements(field: Field, sizes: Mapping[str, int]) -> int:
    return functools.reduce(operator.mul, field.shape(sizes), 1)
