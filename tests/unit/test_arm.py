"""Kernels compile for ARM's processors, with vectors, and call nothing that numba does not bring there.

What this machine compiled is compiled again for another processor, as LLVM's code knows none. Nothing is run.
"""

from __future__ import annotations

import gc
import re

import llvmlite.binding as llvm
import pytest
from numba.core.registry import CPUDispatcher

from liftcore.lifting.warm_up import warm_up_lift
from liftcore.runtime.device import CPU
from liftcore.scene.kernel import Kernel
from liftcore.values.settings import LiftSettings

MACHINES = {"aarch64-unknown-linux-gnu": "generic", "arm64-apple-macosx14.0": "apple-m1"}
# Counting references: for x86 LLVM leaves an instruction of x86 there. Numba builds it anew for each machine.
RELEASE = re.compile(r"define[^\n]*@NRT_decref\([^)]*\)[^{\n]*\{.*?\n\}", re.DOTALL)
VECTORS = re.compile(r"\tf(?:mla|mul|add|sub)\.4s\t|\tf(?:mla|mul|add|sub)\tv\d+\.4s")
CALL = re.compile(r"\tbl?\t([A-Za-z_][\w.$]*)$", re.MULTILINE)
# Numba's runtime, Python's, the C library's and those of other kernels, whose names numba makes.
LIBRARY_CALL = re.compile(
    r"_?(NRT_\w+|numba_\w+|_?Py\w+|mem(cpy|move|set)|bzero|(exp2?|log2?|log1p|sin|cos|pow|floor)f?|_?ZN\w.*)$"
)


@pytest.fixture(scope="module")
def kernels() -> dict[str, str]:
    """Name of each kernel of the default lift -> LLVM's code of it."""
    warm_up_lift(next(iter(Kernel)), CPU, LiftSettings.of())
    codes: dict[str, str] = {}
    for candidate in gc.get_objects():
        if type(candidate) is CPUDispatcher and candidate.py_func.__module__.startswith("liftcore."):
            for number, overload in enumerate(candidate.overloads.values()):
                module = overload.library._get_module_for_linking()  # also of those that lay compiled on the disk
                codes[f"{candidate.py_func.__module__}.{candidate.py_func.__name__} {number}"] = str(module)
    return codes


@pytest.mark.slow
@pytest.mark.parametrize("triple", MACHINES)
def test_kernels_compile_for_arm_with_vectors_and_without_missing_calls(kernels: dict[str, str], triple: str) -> None:
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple)
    machine = target.create_target_machine(cpu=MACHINES[triple], opt=2, reloc="pic", codemodel="small")
    vectors, missing = dict[str, int](), set[str]()
    for name, compiled in kernels.items():
        code = RELEASE.sub("declare void @NRT_decref(ptr)", compiled)
        assert not re.search(r"call [^\n]*@llvm\.x86\.", code), name
        for key, value in (("datalayout", machine.target_data), ("triple", triple)):
            code = re.sub(f'target {key} = "[^"]*"', f'target {key} = "{value}"', code)
        module = llvm.parse_assembly(code)
        module.verify()
        assert machine.emit_object(module)
        assembly = machine.emit_assembly(module)
        defined = set(re.findall(r"^([A-Za-z_][\w.$]*):", assembly, re.MULTILINE))
        missing |= {call for call in set(CALL.findall(assembly)) - defined if not LIBRARY_CALL.match(call)}
        vectors[name.split()[0].rsplit(".", 1)[1]] = len(VECTORS.findall(assembly))
    assert not missing
    assert len(kernels) > 20 and min(vectors["_weigh"], vectors["_render"]) > 50
