"""A fake GPU: tensors in host memory that refuse what tensors of a GPU refuse.

Machines without a GPU find two kinds of mistakes with it: numpy that reads a tensor of the GPU, and a call with
tensors of both devices. Triton's interpreter runs the kernels. Results and times of a GPU come from ``make gpu``.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from liftcore.raster.gpu import launching

PLACE = torch.device("cuda", 0)
MAKERS = ("arange", "as_tensor", "empty", "eye", "full", "linspace", "ones", "rand", "randn", "tensor", "zeros")
_move = Tensor.to


class OnCard(Tensor):
    """A tensor of the fake GPU."""

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call torch with the host tensors behind those of the GPU, and return its output on the GPU.

        Raises:
            TypeError, RuntimeError: where torch raises one for tensors of a GPU.
        """
        name, kwargs = getattr(func, "__name__", ""), kwargs or {}
        if name == "__get__" and func.__self__.__name__ in ("device", "is_cuda"):
            return PLACE if func.__self__.__name__ == "device" else True
        if name in ("numpy", "__array__"):
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        tensors = _tensors((args, kwargs))
        if _mixes(name, args, tensors):
            raise RuntimeError(f"Expected all tensors to be on the same device: {name}")
        places = [leaf for leaf in tree_leaves((args, kwargs)) if _is_place(leaf)]
        is_copy = name == "copy_" and not isinstance(tensors[0], OnCard)
        leaves = is_copy or name == "cpu" or (places and torch.device(places[0]).type == "cpu")
        args, kwargs = tree_map(_behind, (args, kwargs))
        with torch._C.DisableTorchFunctionSubclass():
            output = func(*args, **kwargs)
        return output if leaves else tree_map(_on_card, output)


def lay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make torch and liftcore find the fake GPU."""
    for name in MAKERS:
        monkeypatch.setattr(torch, name, _made_there(getattr(torch, name)))
    monkeypatch.setattr(Tensor, "to", _to)
    monkeypatch.setattr(Tensor, "pin_memory", lambda tensor: tensor)
    answers = {
        "current_device": 0, "current_stream": SimpleNamespace(synchronize=lambda: None), "device": nullcontext(),
        "empty_cache": None, "get_device_capability": (9, 0), "get_device_name": "paper", "is_available": True,
        "mem_get_info": (8 << 30, 8 << 30), "memory_allocated": 0, "memory_reserved": 0,
    }  # fmt: skip
    for name, answer in answers.items():
        monkeypatch.setattr(torch.cuda, name, lambda *_, answer=answer: answer)
    monkeypatch.setattr("liftcore.runtime.device._missing", lambda: None)
    for module in ("tiles", "weights"):
        monkeypatch.setattr(f"liftcore.raster.gpu.{module}.launch", _launch)


def _launch(kernel: Any, programs: int, *arguments: object, **constants: Any) -> None:
    assert all(isinstance(argument, OnCard) for argument in arguments if isinstance(argument, Tensor)), (
        "a kernel reads tensors of the GPU"
    )
    launching.launch(kernel, programs, *map(_behind, arguments), **constants)


def _made_there(make: Callable[..., Any]) -> Callable[..., Any]:
    def make_on_card(*args: Any, device: Any = None, pin_memory: bool = False, **keywords: Any) -> Any:
        if device is None or torch.device(device).type == "cpu":
            return make(*args, device=device, **keywords)
        return _on_card(make(*args, device="cpu", **keywords))

    return make_on_card


def _to(tensor: Tensor, *args: Any, non_blocking: bool = False, **keywords: Any) -> Tensor:
    cuda_devices = [
        leaf for leaf in (*args, *keywords.values()) if _is_place(leaf) and torch.device(leaf).type == "cuda"
    ]
    if isinstance(tensor, OnCard) or not cuda_devices:
        return _move(tensor, *args, **keywords)
    args, keywords = tree_map(_behind, (args, keywords))
    return _on_card(_move(tensor, *args, **keywords, copy=True))


def _mixes(name: str, args: Any, tensors: list[Tensor]) -> bool:
    """Return True if a GPU would refuse these tensors of both devices in one call."""
    if name in ("copy_", "to"):
        return False
    first, indices = tensors[0], _tensors(args[1]) if name in ("__getitem__", "__setitem__") else []
    if name == "__setitem__" and not indices:
        return False  # a slice is copied
    # Scalars of the host, and its indices into a tensor of the GPU, are copied to the GPU.
    host_scalars = [tensor for tensor in tensors if not isinstance(tensor, OnCard) and not tensor.dim()]
    host_scalars += indices if isinstance(first, OnCard) else []
    return (
        len({isinstance(tensor, OnCard) for tensor in tensors if all(tensor is not other for other in host_scalars)})
        > 1
    )


def _tensors(values: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, Tensor)]


def _is_place(value: Any) -> bool:
    return isinstance(value, torch.device) or (isinstance(value, str) and value.split(":")[0] in ("cpu", "cuda"))


def _behind(value: Any) -> Any:
    if isinstance(value, OnCard):
        return value.as_subclass(Tensor)
    return torch.device("cpu") if _is_place(value) else value


def _on_card(value: Any) -> Any:
    return value.as_subclass(OnCard) if type(value) is Tensor else value
