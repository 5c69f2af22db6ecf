"""Memory in the plan, compared with the arrays that a lift allocates."""

from __future__ import annotations

from liftcore.lifting.planning.plan import check_memory, features_room


def test_what_one_phase_frees_is_free_for_the_features_of_another() -> None:
    GB = 10**9
    phases = {"geometry": {"libraries": GB, "view": 6 * GB}, "solve": {"libraries": GB, "codebooks": GB}}
    phases["solve"]["features"] = 6 * GB
    assert check_memory(phases, 10 * GB) == [] and features_room(phases, 10 * GB) == 7 * GB
    (features,) = check_memory(phases, 88 * GB // 10)
    assert features.startswith("the features, 5.6 GiB, do not fit")
    (rest,) = check_memory(phases | {"solve": phases["solve"] | {"features": 1}}, 77 * GB // 10)
    assert rest.startswith("the rest of the lift may take 6.5 GiB")
