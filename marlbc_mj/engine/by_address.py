"""What compiled code receives by address: NamedTuples of arrays, and compiled functions.

The loop takes about ninety arrays in six NamedTuples. numba passes a NamedTuple by value: every function that takes one is
compiled with hundreds of arguments, and every ``team.position`` reads all of it. A :class:`Pointer` is one pointer and reads
only the field. The same source works with both, because attributes have the same names.

numba compiles a function once more into each of its callers. So the large parts of the loop are called by address with
:func:`call`: each is compiled once, and only if it is needed. :func:`entry` compiles a function and returns its address. Its type
contains the types of the arguments, so a wrong argument is a compiler error, not a memory error.
"""

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.errors import TypingError
from numba.core.extending import _Intrinsic
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate
from numba.experimental import structref
from numba.extending import NativeValue, infer_getattr, intrinsic, register_model, unbox

from marlbc_mj.core.compiling import compiled, is_compiled


@structref.register
class _HolderType(types.StructRef):
    """numba's type of :class:`_Holder`."""


class _Holder(structref.StructRefProxy):
    """A NamedTuple in memory that compiled code owns."""


structref.define_proxy(_Holder, _HolderType, ["values"])


class PointerType(types.Type):
    """numba's type of :class:`Pointer`: ``target`` is the type of the NamedTuple."""

    def __init__(self, target: types.BaseTuple) -> None:
        self.target = target
        super().__init__(name=f"Pointer({target})")


@register_model(PointerType)
class _PointerModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: PointerType) -> None:
        super().__init__(manager, kind, manager.lookup(kind.target).get_value_type().as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = PointerType

    def generic_resolve(self, kind: PointerType, name: str) -> Any:
        return kind.target.types[kind.target.fields.index(name)] if name in kind.target.fields else None


@lower_getattr_generic(PointerType)
def _read_field(context, builder, kind, value, name):
    index = kind.target.fields.index(name)
    field = kind.target.types[index]
    found = builder.load(cgutils.gep_inbounds(builder, value, 0, index))
    return impl_ret_borrowed(context, builder, field, found)


@intrinsic
def _address(typing_context, holder):
    def codegen(context, builder, signature, args):
        utils = structref._Utils(context, builder, signature.args[0])
        return builder.ptrtoint(utils.get_data_pointer(args[0]), ir.IntType(64))

    return types.uintp(holder), codegen


@compiled
def _hold(values):
    """Store ``values`` in memory; returns their owner and address."""
    holder = _Holder(values)
    return holder, _address(holder)


class Pointer:
    """A NamedTuple of arrays and numbers that compiled code takes as one pointer. Made by :func:`point_to`.

    In Python it reads like the NamedTuple. Compiled code uses the same arrays; numbers are copied when it is made.
    """

    def __init__(self, values: Any) -> None:
        self.__dict__.update(values._asdict())  # Python finds a field as fast as any attribute
        self.values = values
        self.owner, self.address = _hold(values)
        self._numba_type_ = PointerType(self.owner._numba_type_.field_dict["values"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "values":
            raise AttributeError(name)
        return getattr(self.values, name)

    def _replace(self, **changes: Any) -> "Pointer":
        """Another pointer with some fields changed, as for a NamedTuple."""
        return Pointer(self.values._replace(**changes))

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy points to a copy."""
        return point_to, (self.values,)


def point_to(values: Any) -> Any:
    """A NamedTuple in the form that the loop takes: a :class:`Pointer`, or the NamedTuple itself if numba is off."""
    return values if numba.config.DISABLE_JIT else Pointer(values)


@unbox(PointerType)
def _unbox_pointer(kind, value, c):
    number = c.pyapi.object_getattr_string(value, "address")
    pointer = c.pyapi.long_as_voidptr(number)
    c.pyapi.decref(number)
    return NativeValue(c.builder.bitcast(pointer, c.context.get_value_type(kind)), is_error=c.pyapi.c_api_error())


class EntryType(types.Type):
    """numba's type of :class:`EntryPoint`: ``kinds`` are the argument types of its function."""

    def __init__(self, kinds: tuple[types.Type, ...]) -> None:
        self.kinds = kinds
        super().__init__(name=f"EntryPoint({', '.join(map(str, kinds))})")


class RecordType(types.Type):
    """Type of a pointer among the kinds of an entry: the record's name only, since a record may hold entries that take it."""

    def __init__(self, record: str) -> None:
        super().__init__(name=f"&{record}")


@register_model(EntryType)
class _EntryModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: EntryType) -> None:
        super().__init__(manager, kind, ir.IntType(64))


class EntryPoint:
    """Address of a compiled function for :func:`call`. Made by :func:`entry`, or with the address 0 by :func:`no_entry`."""

    def __init__(self, address: int, kinds: tuple[types.Type, ...]) -> None:
        self.address, self._numba_type_ = address, EntryType(kinds)


@unbox(EntryType)
def _unbox_entry(kind, value, c):
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_ulonglong(number)
    c.pyapi.decref(number)
    return NativeValue(address, is_error=c.pyapi.c_api_error())


def _passed(kind: Any) -> Any:
    """The type of a passed argument: integers as int64, floats as float64, arrays C-contiguous, pointers by name."""
    if isinstance(kind, types.Array):
        return types.Array(kind.dtype, kind.ndim, "C")
    if isinstance(kind, PointerType):
        return RecordType(kind.target.instance_class.__name__)
    if isinstance(kind, types.Integer):
        return types.int64
    return types.float64 if isinstance(kind, types.Float) else kind


def _check(given: Any, wanted: Any) -> None:
    """Raise a numba error unless an argument can be passed as the type that an entry takes."""
    kind = _passed(given)
    if isinstance(given, types.Array) and given.layout != "C":
        raise TypingError(f"an array that is passed to an entry must be contiguous, got {given}")
    if kind != wanted and (kind, wanted) != (types.int64, types.float64):
        raise TypingError(f"an entry takes {wanted}, got {given}")


def _call_at(typing_context, entry, *arguments):
    given = types.BaseTuple.from_types(arguments)
    if not isinstance(entry, EntryType) or len(given) != len(entry.kinds):
        raise TypingError(f"called by address with {given}, got {entry}")
    for pair in zip(given, entry.kinds, strict=True):
        _check(*pair)
    kinds = [own if isinstance(kind, RecordType) else kind for own, kind in zip(given, entry.kinds, strict=True)]

    def codegen(context, builder, signature, args):
        values = cgutils.unpack_tuple(builder, args[1])
        values = [context.cast(builder, *each) for each in zip(values, signature.args[1], kinds, strict=True)]
        function = context.call_conv.get_function_type(types.int64, kinds)
        pointer = builder.inttoptr(args[0], function.as_pointer())
        status, result = context.call_conv.call_function(builder, pointer, types.int64, kinds, values)
        with cgutils.if_unlikely(builder, status.is_error):
            context.call_conv.return_status_propagate(builder, status)
        return result

    return types.int64(entry, given), codegen


class _Call(_Intrinsic):  # type: ignore[misc]  # numba has no types
    """Call a function that returns an integer: directly in Python, by its :class:`EntryPoint` in compiled code."""

    def __call__(self, function, *arguments):
        return function(*arguments)


call = _Call("call", _call_at)
call._register()


def entry(function: Any, *arguments: Any) -> Any:
    """The :class:`EntryPoint` of a compiled ``function`` for such arguments; the function itself if it is not compiled."""
    if not is_compiled(function):
        return function
    given = [numba.typeof(argument) for argument in arguments]
    kinds = [_passed(kind) for kind in given]
    taken = tuple(own if isinstance(kind, RecordType) else kind for own, kind in zip(given, kinds, strict=True))
    function.compile(taken)
    found = function.overloads[taken]
    if types.unliteral(found.signature.return_type) != types.int64:
        raise TypeError(f"{function} returns {found.signature.return_type}; called by address, it must return a whole number")
    return EntryPoint(int(found.library.get_pointer_to_function(found.fndesc.llvm_func_name)), tuple(kinds))


def no_entry(*arguments: Any) -> Any:
    """A placeholder for an unknown :func:`entry`, of the same type. A record class stands for a pointer to such a record."""
    kinds = (RecordType(a.__name__) if isinstance(a, type) else _passed(numba.typeof(a)) for a in arguments)
    return EntryPoint(0, tuple(kinds))
