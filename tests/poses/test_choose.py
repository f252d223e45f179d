"""The choice between the results of two mappers, and the notes about it."""

from __future__ import annotations

from made_up_poses import circle_poses, transform_poses

from hyrfpack.poses.choose import (
    Candidate,
    choose_candidate,
    confirm_each_other,
    confirmed_photos,
    describe_unconfirmed_poses,
)


def make_candidate(mapper: str, poses: dict, explained: int, track: float = 5.0, other_pieces: tuple = ()) -> Candidate:
    return Candidate(mapper, poses, other_pieces, explained, track, 0.4)


def test_the_result_that_explains_more_matches_is_chosen_over_more_photos_or_longer_tracks():
    poses = circle_poses()
    fewer = {name: pose for name, pose in poses.items() if name < "020"}
    right = make_candidate("incremental", fewer, 900, track=4.0)
    folded = make_candidate("global", poses, 700, track=6.0)
    chosen, why = choose_candidate([folded, right], 1000)
    assert chosen is right
    assert "explains more" in why and "90.0% of the matches" in why and "70.0%" in why


def test_on_a_tie_more_photos_and_then_longer_tracks_decide():
    poses = circle_poses()
    fewer = {name: pose for name, pose in poses.items() if name < "020"}
    a, b = make_candidate("incremental", fewer, 901), make_candidate("global", poses, 900)
    assert choose_candidate([a, b], 1000)[0] is b
    a, b = make_candidate("incremental", poses, 901, 5.5), make_candidate("global", poses, 902, 5.0)
    assert choose_candidate([a, b], 1000)[0] is a


def test_disagreement_of_the_mappers_is_noted_and_agreement_is_not():
    poses = circle_poses()
    names = sorted(poses)
    folded = {**poses, **{name: poses[onto] for name, onto in zip(names[16:], names[:8], strict=True)}}
    assert describe_unconfirmed_poses(poses, make_candidate("global", transform_poses(poses), 1000)) == ""
    said = describe_unconfirmed_poses(poses, make_candidate("global", transform_poses(folded), 800))
    assert said.startswith("16 of 24 poses are confirmed by both mappers; the global mapper gives 8 photos other poses")
    nearly = circle_poses(6)
    turned = {**nearly, "x": nearly[min(nearly)]}
    nearly["x"] = nearly[max(nearly)]
    assert "gives 1 photo other poses" in describe_unconfirmed_poses(
        nearly, make_candidate("global", transform_poses(turned), 800)
    )
    lacking = {name: poses[name] for name in names[:10]}
    assert "has no pose for 14" in describe_unconfirmed_poses(
        poses, make_candidate("incremental", transform_poses(lacking), 400)
    )
    assert "the poses of these 24 photos are not confirmed" in describe_unconfirmed_poses(poses, None)


def test_the_largest_agreeing_piece_of_the_other_mapper_confirms_poses():
    poses = circle_poses()
    names = sorted(poses)
    first = transform_poses({name: poses[name] for name in names[:9]}, seed=3)
    second = transform_poses({name: poses[name] for name in names[9:]}, scale=0.2, seed=4)
    other = make_candidate("incremental", first, 500, other_pieces=(second,))
    assert confirmed_photos(poses, other) == set(names[9:])
    assert describe_unconfirmed_poses(poses, other).startswith("15 of 24 poses are confirmed")


def test_two_results_that_agree_on_95_percent_of_the_photos_confirm_each_other():
    poses = circle_poses(40)
    lacking = {name: pose for name, pose in poses.items() if name < "038"}
    assert confirm_each_other([poses], [transform_poses(lacking)], 40)
    assert not confirm_each_other([poses], [transform_poses(lacking)], 41)
    assert not confirm_each_other([poses], [], 40)


def test_results_that_differ_or_have_several_pieces_do_not_confirm_each_other():
    poses = circle_poses(40)
    names = sorted(poses)
    folded = {**poses, **{name: poses[onto] for name, onto in zip(names[30:], names[:10], strict=True)}}
    piece = {name: poses[name] for name in names[:3]}
    assert not confirm_each_other([poses], [transform_poses(folded)], 40)
    assert not confirm_each_other([poses, piece], [transform_poses(poses)], 40)
    assert not confirm_each_other([poses], [transform_poses(poses), piece], 40)
