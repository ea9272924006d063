"""Statements of docs/results.md against the stored tables."""

from functools import cache
from pathlib import Path

import pytest

from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.tables import read_table as read_uncached

read_table = cache(read_uncached)  # each test reads several methods of a table
RESULTS = Path(__file__).parents[3] / "research" / "results"
MIN_JERK_RATIO = 3.0  # smallest ratio of jerks that the page calls "several times"
VIOLATIONS = ["max_commanded_violation", "training_max_commanded_violation"]


def rows_of(study, method, eval_set=None):
    """Return the stored rows of a method; `eval_set` selects one of the evaluation sets."""
    table = read_table(RESULTS / f"{study}.csv")
    rows = table[(table["method"] == method) & ((eval_set is None) | (table["eval_set"] == eval_set))]
    assert len(rows), f"{study} has no rows of {method}"
    return rows


def success_percent(study, method, eval_set=None):
    """Return the success rate of each row of a method, rounded [%]."""
    return (100 * rows_of(study, method, eval_set)["success_rate"]).round().tolist()


def test_baselines_succeed_at_standard_tasks():
    assert (rows_of("connector_baselines", "uniform_random", "per_run")["success_rate"] > 0.5).all()
    assert (rows_of("grid_clamp_baselines", "uniform_random")["success_rate"] > 0.5).all()
    assert (rows_of("pouring_baselines", "best_constant")["success_rate"] > 0.95).all()
    assert (rows_of("narrow_passage_baselines", "demonstration")["success_rate"] == 1.0).all()


@pytest.mark.parametrize(
    ("study", "baseline", "episodes"),
    [("connector_hard_baselines", "demonstration", 200), ("pouring_hard_shield", "zero", 100)],
)
def test_baselines_fail_and_scripted_succeeds_when_hard(study, baseline, episodes):
    for method, largest in ((baseline, 0.05), ("uniform_random", 0.10), ("best_constant", 0.15)):
        rows = rows_of(study, method)
        assert (rows["success_rate"] <= largest).all(), method
        assert (rows["episodes"] >= episodes).all()
    assert (rows_of(study, "scripted")["success_rate"] >= 0.95).all()


def test_only_residual_violates_the_bound_when_hard():
    names = ("kgrl", "skgrl_adaptive", "residual", "safe_residual")
    methods = {method: rows_of("connector_hard", method) for method in names}
    for method, rows in methods.items():
        assert len(rows) >= 5
        assert (rows["success_rate"] >= 0.95).all(), method
        assert (rows["training_episodes"] == 60).all()
        worst = rows[VIOLATIONS]
        assert (worst.max(axis=1) > TOLERANCE).all() if method == "residual" else (worst <= TOLERANCE).all(axis=None)
    rates = [rate for rows in methods.values() for rate in rows["success_rate"]]
    assert (min(rates), max(rates)) == (0.96, 1.0)
    jerk = {method: rows["training_jerk_commanded_linear_first_10"] for method, rows in methods.items()}
    assert MIN_JERK_RATIO * jerk["skgrl_adaptive"].max() < min(jerk["kgrl"].min(), jerk["residual"].min())


def test_residual_far_violates_and_fixed_history_fails_when_hard():
    far, fixed = rows_of("connector_hard", "residual_far"), rows_of("connector_hard", "skgrl")
    assert (far["success_rate"].min(), far["success_rate"].max()) == (0.94, 1.0)
    assert (far["violating_episodes"] == 100).all()
    assert far["max_commanded_violation"].between(1.3e-3, 1.6e-3).all()
    assert (fixed["success_rate"].min(), fixed["success_rate"].max()) == (0.44, 0.93)
    assert (fixed[VIOLATIONS] <= TOLERANCE).all(axis=None)


def test_success_drops_in_mujoco_when_hard():
    rates = [
        rows_of("connector_hard_transfer", method, "MuJoCo")["success_rate"] for method in ("kgrl", "skgrl_adaptive")
    ]
    assert (min(rate.min() for rate in rates), max(rate.max() for rate in rates)) == (0.38, 0.83)


def test_template_needs_least_force_and_residual_most():
    force = {
        method: rows_of(study, method)["peak_force"].max()
        for study, method in (
            ("grid_clamp", "sct"),
            ("grid_clamp_guidance", "none"),
            ("grid_clamp_guidance", "residual"),
        )
    }
    assert force["sct"] < force["none"] < force["residual"]


def test_success_of_peers_at_the_hard_clamp():
    success = {
        method: sorted(success_percent("peers_grid_clamp_hard", method))
        for method in ("sct", "sct_alone", "sct_crossq", "sct_bc", "sct_rlpd", "sct_droq", "residual", "crossq", "none")
    }
    assert all(len(rates) == 10 for rates in success.values())
    assert (success["sct_alone"][0], success["crossq"][0], success["sct_crossq"][0]) == (93, 94, 99)
    assert min(success[method][0] for method in ("sct_bc", "sct_rlpd", "sct_droq")) == 79
    assert (success["none"][0], success["none"][1]) == (0, 97)
    for method in ("residual", "policy_decorator", "droq"):
        assert (rows_of("peers_grid_clamp_hard", method)["success_rate"] == 1.0).all()
    table = read_table(RESULTS / "peers_grid_clamp_hard.csv")
    assert table["training_ended_in_collision"].max() == 0
    assert table["max_commanded_violation"].max() <= TOLERANCE


def test_success_of_peers_at_the_clamp_without_force_bound():
    study = "peers_grid_clamp_hard_unbounded"
    methods = {m: rows_of(study, m) for m in ("sct", "sct_alone", "residual", "policy_decorator", "crossq", "droq")}
    longer = {m: rows_of(study, f"{m}_400") for m in ("residual", "policy_decorator")}
    assert all(len(rows) == 10 for rows in (*methods.values(), *longer.values()))
    mean = {m: round(100 * rows["success_rate"].mean()) for m, rows in methods.items()}
    assert (mean["sct"], mean["policy_decorator"], mean["residual"]) == (98, 56, 39)
    assert (methods["sct_alone"]["success_rate"] == 0.0).sum() == 5
    assert [round(100 * rows["success_rate"].mean()) for rows in longer.values()] == [93, 95]
    stopped = {m: int(rows["training_ended_in_collision"].sum()) for m, rows in methods.items()}
    assert stopped.pop("sct") == 82
    assert stopped.pop("sct_alone") == 145
    assert (min(stopped.values()), max(stopped.values())) == (510, 564)
    assert [int(rows["training_ended_in_collision"].sum()) for rows in longer.values()] == [1495, 1279]
    assert methods["sct"]["ended_in_collision"].sum() == 0
    assert [int(rows["ended_in_collision"].sum()) for rows in longer.values()] == [67, 51]
    assert read_table(RESULTS / f"{study}.csv")["max_commanded_violation"].max() <= TOLERANCE


def test_bounded_force_makes_the_hard_clamp_easy():
    """A search with contact does not end an episode, so random actions often succeed, and residual RL learns."""
    methods = {method: rows_of("grid_clamp_hard", method) for method in ("sct", "residual", "none")}
    assert all((rows["training_ended_in_collision"] == 0).all() for rows in methods.values())
    assert len(methods["sct"]) == 10
    assert methods["sct"]["success_rate"].min() == 0.96
    assert (methods["residual"]["success_rate"] == 1.0).all()
    assert (methods["none"]["success_rate"] <= 0.01).sum() == 4
    baselines = {
        name: rows_of("grid_clamp_hard_baselines", name)["success_rate"] for name in ("zero", "uniform_random")
    }
    assert baselines["zero"].item() == 0.0
    assert 0.5 < baselines["uniform_random"].item() < 0.55
    assert rows_of("grid_clamp_hard_baselines", "scripted")["success_rate"].item() >= 0.95


def test_kgrl_has_no_wall_collision_in_the_passage():
    assert (rows_of("narrow_passage", "kgrl")["training_collisions"] == 0).all()
    assert (rows_of("narrow_passage", "residual")["training_collisions"] > 0).all()
    assert (rows_of("narrow_passage", "safe_residual")["training_success_rate"] < 0.5).all()


def test_skgrl_learns_the_hard_passage_with_every_seed():
    rates = {
        method: success_percent("narrow_passage_hard", method)
        for method in ("kgrl", "skgrl", "residual", "safe_residual")
    }
    assert rates["skgrl"] == [100] * 5
    assert sorted(rates["kgrl"]) == [39, 39, 100, 100, 100]
    assert (min(rates["residual"]), max(rates["residual"])) == (0, 39)
    assert rates["safe_residual"] == [0] * 5
    kgrl, skgrl = (rows_of("narrow_passage_hard", method) for method in ("kgrl", "skgrl"))
    for rows in (kgrl, skgrl):
        assert (rows["training_episodes"] == 120).all()
        assert (rows[VIOLATIONS] <= TOLERANCE).all(axis=None)
    jerk = "training_jerk_commanded_linear_first_10"
    assert kgrl[jerk].min() / skgrl[jerk].max() == pytest.approx(19, abs=1)


def test_clamp_policies_succeed_in_mujoco():
    policies, random = (rows_of("grid_clamp_transfer", method) for method in ("sct", "uniform_random"))
    assert len(policies) == 9
    assert (policies["success_rate"] == 1.0).all()
    assert (policies["episodes"] == 100).all()
    assert (random["success_rate"] > 0.5).all()


def test_certificates_are_valid_and_connector_rz_is_loosest():
    table = read_table(RESULTS / "certificates.csv")
    assert (table["checker"] == "yes").all()
    assert (table["bound_violations"] == 0).all()
    assert (table["attack_steps"] >= 1_000_000).all()
    assert table["worst_ratio_free"].to_numpy() == pytest.approx(1.0, abs=1e-3)
    loosest = table.loc[table["worst_ratio_active"].idxmax()]
    assert (loosest["skill"], loosest["worst_active"]) == ("connector_skgrl", "pose of Rz")
    assert loosest["worst_ratio_active"] == pytest.approx(2.5, abs=0.1)


def test_only_residual_violates_a_bound_within_its_reach():
    for method in ("kgrl", "skgrl_adaptive", "safe_residual", "residual"):
        rows = rows_of("connector_hard_safety", method)
        assert len(rows) == 3
        assert (rows["success_rate"] >= 0.9).all()
        worst = rows[VIOLATIONS].max(axis=1)
        assert worst.between(2.0e-3, 2.1e-3).all() if method == "residual" else (worst <= TOLERANCE).all()
    assert (rows_of("connector_hard_safety", "residual")["success_rate"] == 1.0).all()
    assert rows_of("connector_hard_safety", "safe_residual")["success_rate"].min() == 0.99


def test_template_learns_the_displaced_mug():
    shielded = rows_of("pouring_hard_shield", "rl_sct")
    assert len(shielded) == 10
    assert shielded["success_rate"].min() == 0.99
    assert (shielded["training_ended_in_spill"] == 0).all()
    assert shielded["training_collisions"].sum() == 3
    assert rows_of("pouring_hard", "rl_sct")["success_rate"].tolist() == [0.93, 0.87, 0.98]
    assert rows_of("pouring_hard", "rl_sct_longer")["success_rate"].tolist() == [0.99, 0.91, 0.99]
    assert (rows_of("pouring_hard", "rl_sct_longer")["training_episodes"] == 150).all()
    assert rows_of("pouring_hard", "rl")["success_rate"].tolist() == [0.0, 0.0, 0.0]
    assert (rows_of("pouring_hard", "rl")["training_episodes"] == 300).all()
    assert rows_of("pouring_hard_shield", "scripted_blind")["success_rate"].max() < 1 / 5


def success_range(study, methods, *eval_sets):
    """Return the lowest and the highest success of a seed of these methods in these evaluation sets [%]."""
    rates = [
        rate for method in methods for name in eval_sets or [None] for rate in success_percent(study, method, name)
    ]
    return min(rates), max(rates)


FRICTIONS = [f"MuJoCo, friction × {factor}" for factor in (0.5, 1.5)]


def test_per_episode_policies_succeed_in_mujoco():
    policies = ("kgrl", "skgrl")
    assert success_range("connector_disc", policies) == (99, 100)
    assert success_range("connector_disc_transfer", policies, "MuJoCo", FRICTIONS[0]) == (96, 100)
    assert success_range("connector_disc_transfer", policies, FRICTIONS[1]) == (86, 100)
    peak_forces = [
        rows[rows["success_rate"] == 1.0]["peak_force"].max()
        for rows in (rows_of("connector_disc", "kgrl"), rows_of("connector_disc_transfer", "kgrl", "MuJoCo"))
    ]
    assert peak_forces[1] < 1.2 * peak_forces[0]
    assert success_range("connector_disc_transfer", ["uniform_random"], "MuJoCo")[0] > 50


def test_finer_contact_transfers_to_mujoco_and_other_frictions():
    fine, policies = "connector_hard_fine", ("kgrl", "skgrl_adaptive")
    assert success_range(fine, policies, "fresh") == (82, 100)
    assert success_range(fine, policies, "MuJoCo") == (74, 98)
    assert success_range(fine, ["kgrl_randomized"], "MuJoCo") == (91, 95)
    assert success_range(f"{fine}_transfer", policies, *FRICTIONS) == (77, 99)
    for method, rates in (("residual", (92, 100)), ("scripted", (88, 100)), ("uniform_random", (5, 7))):
        assert success_range(fine, [method], "fresh", "MuJoCo") == rates
    for method, rates in (("scripted", (58, 97)), ("uniform_random", (5, 12)), ("demonstration", (0, 0))):
        assert success_range(f"{fine}_transfer", [method], *FRICTIONS) == rates
    assert rows_of(fine, "residual")["max_commanded_violation"].min() > TOLERANCE
    for method in policies:
        assert (rows_of(fine, method)[VIOLATIONS] <= TOLERANCE).all(axis=None)
        assert (rows_of(f"{fine}_transfer", method)["max_commanded_violation"] <= TOLERANCE).all()


def test_policies_of_the_gantry_transfer_to_mujoco_and_arms():
    gantry, arms = "connector_hard_gantry", ("iiwa", "Panda", "UR5e")
    assert success_range(gantry, ["kgrl"], "MuJoCo") == (77, 99)
    assert success_range(gantry, ["kgrl"], *arms) == (77, 100)
    assert success_range(gantry, ["scripted"], "MuJoCo") == (89, 89)


def test_random_actions_seldom_lock_the_connector_when_hard():
    assert success_percent("connector_hard_converged", "uniform_random") == [9]


def test_covariance_without_constraints_leaves_the_passage():
    """In held-out episodes; the largest violation in training is 73 mm."""
    rows = rows_of("peers_narrow_passage_hard", "residual_covariance")
    assert rows["success_rate"].tolist() == rows_of("peers_narrow_passage_hard", "kgrl")["success_rate"].tolist()
    assert rows["violating_episodes"].sum() == 610
    assert 1000 * rows["max_commanded_violation"].max() == pytest.approx(71, abs=0.5)


def test_force_shortens_episodes_without_force_bound():
    rows = {method: rows_of("peers_grid_clamp_hard_unbounded", method) for method in ("sct", "residual", "crossq")}
    steps = {method: rows_of_method["training_total_steps"].mean() for method, rows_of_method in rows.items()}
    assert steps == pytest.approx({"sct": 7800, "residual": 1200, "crossq": 1200}, abs=50)


def test_skill_in_engines_stays_below_the_force_limit():
    table = read_table(RESULTS / "engines.csv")
    policies = table[table["method"] != "uniform_random"]
    assert policies["peak_force"].max() == pytest.approx(16.4, abs=0.05)
    assert policies["peak_contact_force"].max() == pytest.approx(18.2, abs=0.05)
    assert policies["training_collisions"].sum() == 0


def sweep_success(study, method, quantity, value):
    """Return the success rate of all seeds of a method together, at a value of the varied quantity [%]."""
    rows = rows_of(study, method, f"{quantity} {value}")
    return round(100 * float((rows["success_rate"] * rows["episodes"]).sum() / rows["episodes"].sum()))


def test_connector_sweep_breaking_points():
    distance, force = "distance of the jack [mm]", "force limit [N]"
    assert [sweep_success("connector_sweep", "kgrl", distance, at) for at in (0.5, 1.5)] == [85, 80]
    for method in ("kgrl", "skgrl_adaptive", "residual"):
        assert sweep_success("connector_sweep", method, distance, 3.25) == 100
        assert sweep_success("connector_sweep", method, distance, 3.75) <= 60
    for method in ("kgrl", "skgrl_adaptive", "scripted"):
        assert [sweep_success("connector_sweep", method, force, at) for at in (20, 15, 13, 11)] == [100, 100, 100, 0]
    assert [sweep_success("connector_sweep", "residual", force, at) for at in (20, 15, 13, 11)] == [100, 70, 0, 0]
    for quantity, values in (("mouth chamfer [mm]", (0.4, 0.2, 0.1, 0.05)), ("friction", (0.1, 0.2, 0.3, 0.4))):
        for method in ("kgrl", "skgrl_adaptive", "residual", "scripted"):
            assert min(sweep_success("connector_sweep", method, quantity, at) for at in values) >= 90


def test_grid_clamp_sweep_breaking_points():
    force, chamfers = "force limit [N]", "holes' and pegs' chamfers together [mm]"
    assert [sweep_success("grid_clamp_sweep", "sct", force, at) for at in (35, 10, 9)] == [100, 100, 100]
    assert [sweep_success("grid_clamp_sweep", "uniform_random", force, at) for at in (35, 15, 10)] == [91, 91, 4]
    assert sweep_success("grid_clamp_sweep", "sct", chamfers, 0.5) == 91
    assert sweep_success("grid_clamp_sweep", "scripted", chamfers, 0.5) == 67


def test_pouring_sweep_breaking_points():
    result = {
        method: [sweep_success("pouring_sweep", method, "mug offset [mm]", at) for at in (0, 15, 25, 35, 45, 60)]
        for method in ("rl_sct", "scripted", "scripted_blind", "uniform_random", "zero", "best_constant")
    }
    assert result["rl_sct"] == [100, 100, 93, 97, 97, 87]
    assert result["scripted"] == [100] * 6
    assert result["scripted_blind"] == [100, 100, 80, 33, 10, 0]
    assert result["uniform_random"] == result["zero"] == result["best_constant"] == [0] * 6


def test_narrow_passage_sweep_breaking_points():
    width, radius = "width of the gap [mm]", "radius of the obstacles [mm]"
    rates = {"kgrl": 100, "skgrl": 100, "residual": 32, "safe_residual": 0, "scripted": 100, "uniform_random": 0}
    for method, rate in rates.items():
        assert {sweep_success("narrow_passage_sweep", method, width, at) for at in (60, 45, 30, 25, 20)} == {rate}
    for method in ("kgrl", "skgrl"):
        assert {sweep_success("narrow_passage_sweep", method, radius, at) for at in (40, 60, 70, 80, 90, 100)} == {100}
    assert [sweep_success("narrow_passage_sweep", "demonstration", radius, at) for at in (40, 60, 70)] == [100, 32, 0]


def test_settings_of_the_thesis_do_not_reproduce_its_success():
    kgrl, skgrl, random = (rows_of("connector_thesis", method) for method in ("kgrl", "skgrl", "uniform_random"))
    assert success_percent("connector_thesis", "kgrl") == [6, 60, 17]
    assert kgrl["training_success_rate"].between(0.55, 0.65).all()
    assert (skgrl[["success_rate", "training_success_rate"]] == 0.0).all(axis=None)
    assert random["success_rate"].between(0.37, 0.70).all()
    for rows in (kgrl, skgrl):
        assert (rows["training_episodes"] == 45).all()
        assert (rows[VIOLATIONS] <= TOLERANCE).all(axis=None)


def ended_percent(study, method, termination="collision"):
    """Return the percentage of a method's training episodes that ended in a collision or spill."""
    rows = rows_of(study, method).drop_duplicates("seed")
    return 100 * rows[f"training_ended_in_{termination}"].sum() / rows["training_episodes"].sum()


def test_force_ends_training_episodes_without_force_bound():
    methods = ("kgrl", "skgrl_adaptive", "residual", "safe_residual", "residual_far")
    percentages = [ended_percent("connector_hard", method) for method in methods]
    percentages += [ended_percent("connector_hard_fine", method) for method in ("kgrl", "skgrl_adaptive", "residual")]
    assert all(14.5 <= percentage <= 25 for percentage in percentages)
    assert round(ended_percent("connector_hard", "skgrl")) == 63
    ended = [180 * ended_percent("grid_clamp_sweep", method) / 100 for method in ("sct", "residual")]
    assert ended == pytest.approx([22, 166])


def test_spills_and_obstacles_end_training_episodes():
    spills = [ended_percent("pouring_hard", method, "spill") for method in ("rl_sct", "rl_sct_longer", "rl")]
    assert spills == pytest.approx([92 / 3, 104 / 4.5, 0])
    passage = [round(ended_percent("peers_narrow_passage_hard", m)) for m in ("skgrl", "residual_covariance", "kgrl")]
    assert passage == [36, 39, 41]
    others = ["residual", "safe_residual", "residual_cbf", "residual_tangent", "policy_decorator"]
    others += ["crossq", "rlpd", "droq"]
    assert all(51.5 < ended_percent("peers_narrow_passage_hard", method) < 69.5 for method in others)


def test_skgrl_reduces_jerk_as_stated():
    """sKGRL has less measured linear jerk than KGRL, and more commanded angular jerk."""
    ratios = {}
    for study in ("connector_hard", "connector_hard_fine", "connector_hard_safety", "peers_connector_hard"):
        for name in ("measured_linear", "commanded_angular"):
            kgrl, skgrl = (
                rows_of(study, method).drop_duplicates("seed")[f"training_jerk_{name}_first_10"].mean()
                for method in ("kgrl", "skgrl_adaptive")
            )
            ratios[study, name] = kgrl / skgrl if name == "measured_linear" else skgrl / kgrl
    measured = [ratio for (_, name), ratio in ratios.items() if name == "measured_linear"]
    assert (min(measured), max(measured)) == pytest.approx((1.5, 2.1), abs=0.05)
    angular = [ratios[study, "commanded_angular"] for study in ("connector_hard", "connector_hard_safety")]
    assert angular == pytest.approx([3.4, 2.8], abs=0.05)


def test_cloned_slalom_succeeds_with_guidance():
    for method, rate in (("bc", 0.39), ("bc_kgrl", 1.0), ("bc_skgrl", 1.0)):
        assert rows_of("peers_narrow_passage_hard_bc", method)["success_rate"].tolist() == 10 * [rate]
