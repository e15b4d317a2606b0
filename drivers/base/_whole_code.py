"""Machine code of a whole call tree at once: a compiled function that compiled functions call is a part.

Numba would optimise each function for itself and again in each function above it, and make machine code of
it with a wrapper for Python. A part has none of these: it is linked into the functions that Python calls, and
is optimised there. It has one version for all integers of its callers: each constant would get one.
"""

# ruff: noqa: SLF001 - numba has no public names of these
from __future__ import annotations

from hashlib import sha256
from typing import Any

from numba.core import compiler, sigutils, types, typing
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target

from drivers.base.compile_report import progress
from drivers.base.kept_code import keeps


class _Code(JITCodeLibrary):  # type: ignore[misc]  # numba has no types
    """Machine code of a function and all parts below, or the code of a part, for links only."""

    is_part = False

    def finalize(self) -> None:
        """Make machine code; a part waits for the function that is called by Python."""
        if self.is_part:
            self._finalized = True
            return
        # Callers first: LLVM links a function only if it is called from code that it has linked before.
        self._linking_libraries = list(reversed(_below(self, {})))
        super().finalize()

    def _verify_declare_only_symbols(self) -> None:
        """Raise AssertionError for a compiled function without its code: the first call of it would crash."""
        for function in self._final_module.functions:
            if function.is_declaration and function.name.startswith("_ZN"):
                raise AssertionError(f"{self.name} calls {function.name}, which is not linked")


def _below(code: Any, found: dict[Any, None]) -> dict[Any, None]:
    """Return the code that `code` calls, and that its parts call, each once, behind all that it calls."""
    for called in code._linking_libraries:
        if called not in found:
            if getattr(called, "is_part", False):
                _below(called, found)
            found[called] = None
    return found


class _Parts:
    """The versions of a function for calls by compiled code."""

    def __init__(self, made: Any) -> None:
        self._made = made
        self._versions: dict[tuple[Any, ...], tuple[Any, Any]] = {}
        """Signature and key of the code, by types of arguments."""

    def template(self, arguments: Any, keywords: Any) -> Any:
        """Return what `numba.core.dispatcher.Dispatcher.get_call_template` does."""
        general = {name: _general(kind) for name, kind in keywords.items()}
        names, folded = self._made.fold_argument_types(tuple(map(_general, arguments)), general)
        name = self._made.py_func.__name__
        signatures = [self._version(tuple(folded))[0]]
        return typing.make_concrete_template(name, key=name, signatures=signatures), names, folded, {}

    def overload(self, signature: Any) -> Any:
        """Return the key under which numba finds the code of `signature`."""
        return self._version(tuple(sigutils.normalize_signature(signature)[0]))[1]

    def _version(self, arguments: tuple[Any, ...]) -> tuple[Any, Any]:
        if arguments not in self._versions:
            self._versions[arguments] = self._compiled(arguments)
        return self._versions[arguments]

    def _compiled(self, arguments: tuple[Any, ...]) -> tuple[Any, Any]:
        if arguments in self._made.overloads or keeps(self._made, arguments):
            key = self._made.compile(arguments)
            return self._made.overloads[arguments].signature, key
        maker = self._made._compiler
        flags = compiler.Flags()
        maker.targetdescr.options.parse_as_flags(flags, maker.targetoptions)
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        context = maker.targetdescr.target_context
        code = _Code(context.codegen(), self._made.py_func.__qualname__)
        code.is_part = True
        progress.note()
        done = compiler.compile_extra(
            maker.targetdescr.typing_context,
            context,
            self._made.py_func,
            args=arguments,
            return_type=None,
            flags=flags,
            locals=maker.locals,
            library=code,
            pipeline_class=maker.pipeline_class,
        )
        progress.note(self._made)
        done.fndesc.typemap = done.fndesc.calltypes = None  # large, and not used again
        context.insert_user_function(code, done.fndesc, [code])
        return done.signature, code


def _general(kind: Any) -> Any:
    """Return the numba type that an argument of the type `kind` is passed as: an integer as int64."""
    is_integer = isinstance(kind, types.Integer | types.IntEnumMember) and kind != types.uint64
    return types.int64 if is_integer else kind


def make_part(made: Any) -> None:
    """Let the function that numba has `made` be a part of functions that call it, unless it is on disk."""
    parts = _Parts(made)
    made.get_call_template, made.get_overload = parts.template, parts.overload


def _shorten_names() -> None:
    """Name types of records by a digest: numba repeats all fields of arguments in the name of a function."""
    record: Any = types.Record
    describe = record.__init__

    def named(self: Any, *arguments: Any, **keywords: Any) -> None:
        describe(self, *arguments, **keywords)
        self.name = f"Record_{sha256(self.name.encode()).hexdigest()[:16]}"

    record.__init__ = named


def _compare_flags_quickly() -> None:
    """Let numba's flags, which it compares at each operation, read their values in one step."""
    defaults = {name: option.default for name, option in compiler.Flags.options.items()}
    compiler.Flags.values = lambda flags: defaults | flags._values


cpu_target.target_context.codegen()._library_class = _Code
_shorten_names()
_compare_flags_quickly()
