"""Page of the sliders, a marimo app. It only connects sliders to figures; `server.py` runs it and selects the scene."""

import marimo

app = marimo.App(width="full", app_title="jaxvib explore")


@app.cell
def _():
    import html

    import marimo as mo

    from jaxvib.errors import InputError
    from jaxvib.explore import figures
    from jaxvib.explore.server import served_path
    from jaxvib.explore.sliders import scene_at, sliders_of, typed_value
    from jaxvib.machine.files import load_scene

    return InputError, html, load_scene, mo, figures, scene_at, served_path, sliders_of, typed_value


@app.cell
def _(load_scene, mo, served_path, sliders_of):
    path = served_path()
    scene = load_scene(path)
    sliders = {each.title: each for each in sliders_of(scene)}
    # The sliders begin at these values. A move of a slider changes `current` only, so that the sliders are not built anew.
    starts, set_starts = mo.state({each.name: each.start for each in sliders.values()})
    current = {}
    problem, set_problem = mo.state("")
    return current, path, problem, scene, set_problem, set_starts, sliders, starts


@app.cell
def _(InputError, current, html, mo, path, scene, set_problem, set_starts, sliders, typed_value):
    def set_slider(typed):
        try:
            slider = sliders[typed["name"]]
            set_starts({**current, slider.name: typed_value(scene, slider, typed["value"])})
            set_problem("")
        except InputError as error:
            set_problem(str(error))

    names = mo.ui.dropdown(
        list(sliders), value=next(iter(sliders)), allow_select_none=False, label="set a slider to a number", full_width=True
    )
    value = mo.ui.text(placeholder="number", full_width=True)
    field = (
        mo.md("{name}\n\n{value}")
        .batch(name=names, value=value)
        .form(submit_button_label="Set", bordered=False, on_change=set_slider)
    )
    # The file name is escaped because it may contain HTML.
    mo.sidebar([mo.Html(f"<b>{html.escape(path.name)}</b>"), field], width="22rem")
    return


@app.cell
def _(mo, sliders, starts):
    controls = mo.ui.dictionary(
        {
            each.name: mo.ui.slider(
                steps=sorted({*each.steps, starts()[each.name]}),
                value=starts()[each.name],
                label=each.title,
                show_value=True,
                full_width=True,
            )
            for each in sliders.values()
        }
    )
    return (controls,)


@app.cell
def _(html, mo, problem):
    mo.sidebar(mo.Html(f"<p>{html.escape(problem())}</p>"), width="22rem")
    return


@app.cell
def _(controls, mo):
    mo.sidebar([mo.vstack(list(controls.elements.values()))], width="22rem")
    return


@app.cell
def _(controls, current, figures, scene, scene_at):
    current.update(controls.value)
    machine = figures.scene_or_problem(lambda: scene_at(scene, controls.value))
    return (machine,)


@app.cell
def _(machine, mode, figures, scene):
    # All figures are computed before any is sent, because a browser that draws one would slow down the next computation.
    chart = figures.image(lambda: figures.diagram(machine.value, 4.0 / 3.0 * float(scene.top_speed)), machine)
    numbers = figures.text(lambda: figures.readings(machine.value), machine)
    animation = figures.image(lambda: figures.machine(machine.value, mode.value), machine)
    return chart, animation, numbers


@app.cell
def _(chart, mo):
    mo.Html(chart)
    return


@app.cell
def _(mo, numbers):
    mo.Html(numbers)
    return


@app.cell
def _(mo, figures, scene):
    # The list has all modes that are stable by slope, because other values of the sliders can make each of them exist.
    found = figures.modes_of(scene)
    modes = {str(k): k for k in sorted(found)}
    mode = mo.ui.dropdown(
        modes or {"none": None},
        value=next(iter(map(str, found)), "none"),
        allow_select_none=False,
        label="jam mode in which the machine moves",
    )
    mo.vstack([mode] if modes else [])
    return (mode,)


@app.cell
def _(animation, mo):
    mo.Html(animation)
    return


@app.cell
def _(mo, figures, scene):
    mo.md(figures.about(scene))
    return


@app.cell
def _(machine, mo, path, figures):
    mo.sidebar(
        mo.download(
            data=figures.toml(machine, path).encode(),
            filename=f"{path.stem}-explored.toml",
            mimetype="text/plain",
            label="Save this machine as TOML",
            disabled=machine.problem != "",
        )
    )
    return


if __name__ == "__main__":
    app.run()
