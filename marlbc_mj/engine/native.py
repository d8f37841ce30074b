"""Unsafe calls from compiled code: MuJoCo and laws by address.

Each function here has two versions. Called from Python it takes objects: a law, ``mujoco.mj_step``, an array. Inside compiled
code it takes their addresses, plain integers, so that the compiled loop stays cached on disk whatever it calls. The caller must
keep the owner of an address (MjModel, MjData, law) alive during the call.
"""

import ctypes

import mujoco
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import _Intrinsic
from numba.extending import intrinsic, overload
from numba.np.arrayobj import populate_array

from marlbc_mj.core import laws


def step_address() -> int:
    """Address of ``mj_step`` in the library that the mujoco package has loaded."""
    library = ctypes.CDLL(mujoco._functions.__file__)
    return int(ctypes.cast(library.mj_step, ctypes.c_void_p).value or 0)


class _LogConfig(ctypes.Structure):
    """MuJoCo's mjLogConfig."""

    _fields_ = (
        ("to_console", ctypes.c_bool),
        ("to_file", ctypes.c_bool),
        ("file", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    )


def keep_mujoco_quiet() -> None:
    """Keep ``mj_step``, when called by address, from printing and from writing MUJOCO_LOG.TXT into the current folder.

    A world that diverges raises this package's own error, with agent and time. Calls through MuJoCo's Python package still warn.
    """
    library = ctypes.CDLL(mujoco._functions.__file__)
    if hasattr(library, "mju_setLogConfig"):
        library.mju_setLogConfig.argtypes = (_LogConfig,)
        library.mju_setLogConfig.restype = None
        library.mju_setLogConfig(_LogConfig(False, False, b"", 0))


keep_mujoco_quiet()


def call_step(step, model, data):
    """Call ``step(model, data)``, where ``step`` is ``mj_step``."""
    step(model, data)


def as_behavior(law):
    """Turn the address of a behavior into a callable."""
    return law


def as_controller(law):
    """Turn the address of a team controller into a callable."""
    return law


def as_disturbance(law):
    """Turn the address of a team disturbance into a callable."""
    return law


def as_drive(law):
    """Turn the address of a team drive into a callable."""
    return law


def as_reading(law):
    """Turn the address of a team reading into a callable."""
    return law


@intrinsic
def _call_address(typing_context, step, model, data):
    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 2)
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), [args[1], args[2]])
        return context.get_dummy_value()

    return types.void(types.uintp, types.uintp, types.uintp), codegen


def _doubles_at(typing_context, address, n):
    def codegen(context, builder, signature, args):
        array = context.make_array(signature.return_type)(context, builder)
        size = context.get_constant(types.intp, 8)
        data = builder.inttoptr(args[0], array.data.type)
        populate_array(array, data=data, shape=[args[1]], strides=[size], itemsize=size, meminfo=None)
        return array._getvalue()

    return types.float64[::1](types.uintp, types.intp), codegen


class _Doubles(_Intrinsic):  # type: ignore[misc]
    """The n float64 of one of MuJoCo's arrays: the array itself in Python, a non-owning view of its address in compiled code."""

    def __call__(self, array, n):
        return array


doubles = _Doubles("doubles", _doubles_at)  # no overload: without reference counting, none may return an array
doubles._register()


@overload(call_step, inline="always")
def _call_step(step, model, data):
    return lambda step, model, data: _call_address(step, model, data)


def _compile_as(function, kind):
    """Give ``function`` its compiled version, which turns an address into a law of signature ``kind``."""
    function_type = types.FunctionType(kind)

    @intrinsic
    def from_address(typing_context, law):
        def codegen(context, builder, signature, args):
            struct = cgutils.create_struct_proxy(function_type)(context, builder)
            pointer = builder.inttoptr(args[0], context.get_value_type(types.voidptr))
            struct.c_addr = struct.py_addr = struct.jit_addr = pointer
            return struct._getvalue()

        return function_type(types.uintp), codegen

    @overload(function, inline="always")
    def compiled_face(law):
        return lambda law: from_address(law)


_compile_as(as_behavior, laws.BEHAVIOR)
_compile_as(as_controller, laws.TEAM_CONTROLLER)
_compile_as(as_disturbance, laws.TEAM_DISTURBANCE)
_compile_as(as_drive, laws.TEAM_DRIVE)
_compile_as(as_reading, laws.TEAM_READING)
