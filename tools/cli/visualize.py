"""`guiderail visualize` and `guiderail report`."""

from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import option


@cli.command("visualize runs/passage --html replay.html")
def visualize(
    subject: cli.Subject,
    html: Annotated[
        Path | None,
        option(
            "Page to write, .html.  [default: replay.html, or replay-STATION.html with a station, in the run or the "
            "current folder; none with --image or --video]"
        ),
    ] = None,
    image: Annotated[Path | None, option("Picture of six camera frames to write: {pictures}.")] = None,
    video: Annotated[Path | None, option("Animated camera image to write: {videos}.")] = None,
    seed: cli.Seed = 1_000_000,
    env: cli.Env = None,
    station: Annotated[str | None, option("Station: {stations}.  [default: the run's]", choices="stations")] = None,
    policy: Annotated[
        str | None, option("Policy that acts in a TASK: scripted, {baselines}.  [default: scripted]")
    ] = None,
    task: cli.PolicyTask = None,
    trust_policy: cli.TrustPolicy = False,
    episodes: Annotated[int | None, option("Number of held-out episodes on the page.  [default: 4]")] = None,
    overwrite: Annotated[
        bool, option("Replace existing files; those in the run's own folder are always replaced.", "--overwrite")
    ] = False,
    imports: cli.TaskImports = None,
    trust_imports: cli.TrustImports = False,
) -> None:
    """Show held-out episodes as a page that any browser opens, and redraw the learning curve of a run.

    The page compares episodes before and after learning on one time axis: robots in motion, demonstrations, paths,
    constraints, and plots of force, violation, action and phase. It is self-contained. "Before" is the demonstration
    alone if the guidance has one, and random actions otherwise.
    """
    from guiderail.tools.evaluation.subject import EpisodeSpec
    from guiderail.tools.files import check_picture, check_video
    from guiderail.tools.visualization.camera import write_image, write_video
    from guiderail.tools.visualization.curves import plot_run
    from guiderail.tools.visualization.replay import default_page, write_page

    environment = cli.parse_environment(env, station=station)
    name = cli.find_task(subject, imports)[0]
    if policy is not None and (task is not None or Path(name).is_dir()):
        raise InputError("--policy acts in a task: name the task instead of a folder, or leave --policy out")
    if task is not None:
        task = cli.find_task(task)[0]
    elif not Path(name).is_dir() and name in cli.CHOICES["tasks"]():
        name, task = policy or "scripted", name
    episode = EpisodeSpec.of_policy(name, environment, seed, task=task, trust_policy=trust_policy)
    if episodes is not None and html is None and (image is not None or video is not None):
        raise InputError("--episodes are those of the page: add --html, or leave --episodes out")
    if image is not None:
        check_picture(image)
    if video is not None:
        check_video(video)
    if html is None and image is None and video is None:
        html = default_page(Path(subject) if episode.run is None else episode.run, environment)
    own = None if episode.run is None else episode.run.resolve()
    for path in (html, image, video):
        if path is not None and path.exists() and not overwrite and path.resolve().parent != own:
            raise InputError(f"{path} exists already: name another file, or give --overwrite")
    if html is not None:
        write_page(html, episode, episodes=episodes)
        if episode.run is not None:
            typer.echo(plot_run(episode.run))
        typer.echo(html)
    for path, write in ((image, write_image), (video, write_video)):
        if path is not None:
            write(path, episode)
            typer.echo(path)
