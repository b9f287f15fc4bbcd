"use strict";

// Tables: a click on a heading sorts by it, another one turns the order.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th");
    const body = head.closest("table").tBodies[0];
    const place = [...head.parentNode.children].indexOf(head);
    const ascending = head.getAttribute("aria-sort") !== "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const key = (row) => row.cells[place].dataset.value ?? "";
    const compare = (a, b) => {
      // What has no number stays below, whatever the order.
      if (key(a) === "" || key(b) === "") return (key(a) === "") - (key(b) === "");
      const difference = Number(key(a)) - Number(key(b));
      const order = Number.isNaN(difference) ? key(a).localeCompare(key(b)) : difference;
      return ascending ? order : -order;
    };
    body.append(...[...body.rows].sort(compare));
  });
}

// Worlds and methods: what belongs to others is hidden.
const choice = ["world", "method"].map((kind) => [kind, document.getElementById(`only-${kind}`)]);
const choose = () => {
  for (const [kind, select] of choice) {
    for (const element of document.querySelectorAll(`[data-${kind}]`)) {
      element.classList.toggle(`other-${kind}`, select.value !== "" && element.dataset[kind] !== select.value);
    }
  }
};
for (const [, select] of choice) select.addEventListener("change", choose);
choose();

// The player: replays the episodes stored in the page, one policy or two side by side.
const data = document.getElementById("episodes");
if (data) {
  const { scenes, runs } = JSON.parse(data.textContent);
  const find = (id) => document.getElementById(id);
  const [env, method, eta, seed, chance, episode, beside, scrub, play] =
    ["env", "method", "eta", "seed", "chance", "episode", "beside", "scrub", "play"].map(find);
  const stages = ["", "beside-"].map((place) => ({
    box: find(`${place}stage`),
    words: find(`${place}step`),
    context: find(`${place}scene`).getContext("2d"),
    shown: null,
  }));
  const state = { time: 0, timer: null, scene: null };
  const names = { nominal: "nominal chance", antagonist: "learned antagonist" };
  const distinct = (values) => [...new Set(values)];
  const called = (run) => [run.method, `eta = ${run.eta}`, run.seed === null ? null : `seed ${run.seed}`]
    .filter((part) => part !== null).join(", ");

  const fill = (select, options) => {
    const old = select.value;
    select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    if (options.some(([value]) => String(value) === old)) select.value = old;
  };

  const select = () => {
    pause();
    fill(env, distinct(runs.map((run) => run.env)).map((name) => [name, name]));
    const ofEnv = runs.filter((run) => run.env === env.value);
    fill(method, distinct(ofEnv.map((run) => run.method ?? "")).map((name) => [name, name || "trained"]));
    const ofMethod = ofEnv.filter((run) => (run.method ?? "") === method.value);
    fill(eta, distinct(ofMethod.map((run) => run.eta)).map((value) => [value, value]));
    const ofEta = ofMethod.filter((run) => String(run.eta) === eta.value);
    fill(seed, ofEta.map((run) => [run.seed ?? "", run.seed ?? "none"]));
    const run = ofEta.find((run) => String(run.seed ?? "") === seed.value);
    state.scene = scenes[run.scene];
    fill(chance, distinct(run.stored.map((of) => of.chance)).map((kind) => [kind, names[kind]]));
    const stored = run.stored.map((of, place) => [of, place]).filter(([of]) => of.chance === chance.value);
    fill(episode, stored.map(([of, place]) => [place, `${of.index}: ${of.end} after ${of.actions.length} steps`]));
    const shown = run.stored[Number(episode.value)];
    // Under nominal chance all policies of a scene and a stream of noise meet the same noise in an episode of one index.
    const twin = (other) => other.stored.find((of) => of.chance === "nominal" && of.index === shown.index);
    const others = runs.map((other, place) => [other, place]).filter(([other]) => shown.chance === "nominal"
      && other !== run && other.scene === run.scene && other.stream === run.stream && twin(other) !== undefined);
    fill(beside, [["", "nothing"], ...others.map(([other, place]) => [place, called(other)])]);
    const other = beside.value === "" ? null : runs[Number(beside.value)];
    [[run, shown], [other, other && twin(other)]].forEach(([of, shown], place) => {
      Object.assign(stages[place], { shown, name: of && called(of) });
      stages[place].box.hidden = shown === null;
    });
    scrub.max = Math.max(...active().map((stage) => stage.shown.actions.length));
    show(0);
  };

  const active = () => stages.filter((stage) => stage.shown !== null);

  const show = (time) => {
    state.time = time;
    scrub.value = time;
    for (const stage of active()) {
      draw(stage, Math.min(time, stage.shown.actions.length));
      stage.words.textContent = describe(stage, time).join(" · ");
    }
  };

  const describe = ({ name, shown: { actions, ratios, budgets, value, end } }, at) => {
    const time = Math.min(at, actions.length);
    const number = (x) => (x >= 100 ? x.toFixed(0) : x.toPrecision(3));
    const lines = [name, `step ${time} of ${actions.length}`];
    if (ratios.length > 0) lines.push(`remaining budget ${number(budgets[time])}`);
    if (ratios.length > 0 && time > 0) {
      lines.push(`likelihood ratio of the last outcome ${number(ratios[time - 1])}`);
      lines.push(`product so far ${number(ratios.slice(0, time).reduce((a, b) => a * b, 1))}`);
    }
    if (time === actions.length) lines.push(`ended: ${end}, return ${value.toFixed(3)}`);
    return lines;
  };

  const draw = ({ context, shown: { path, actions, outcomes } }, time) => {
    const { scene } = state;
    const { canvas } = context;
    const style = getComputedStyle(document.documentElement);
    const ink = style.getPropertyValue("--ink");
    const unit = canvas.width / scene.size[0];
    canvas.height = Math.round(unit * scene.size[1]);
    // A cell's place is its corner, a body's its centre.
    const offset = scene.cells ? 0.5 : 0;
    const at = ([x, y]) => [(x + offset) * unit, (y + offset) * unit];
    const line = (from, to) => {
      context.beginPath();
      context.moveTo(...from);
      context.lineTo(...to);
      context.stroke();
    };
    const arrow = (from, [dx, dy], colour) => {
      const length = Math.hypot(dx, dy);
      if (length < 0.05) return;
      const scale = scene.cells ? 0.6 : 0.8;
      const tip = [from[0] + dx * scale, from[1] + dy * scale];
      context.strokeStyle = colour;
      context.lineWidth = 5;
      line(at(from), at(tip));
      const barb = (sign) => [tip[0] - 0.2 * (dx / length - sign * 0.6 * dy / length),
        tip[1] - 0.2 * (dy / length + sign * 0.6 * dx / length)];
      line(at(tip), at(barb(1)));
      line(at(tip), at(barb(-1)));
    };
    context.clearRect(0, 0, canvas.width, canvas.height);
    for (const { kind, min, max } of scene.areas) {
      context.fillStyle = { lava: "#d55e00", goal: "#009e73", "lesser-goal": "#7fceb9", wall: ink }[kind];
      context.fillRect(min[0] * unit, min[1] * unit, (max[0] - min[0]) * unit, (max[1] - min[1]) * unit);
    }
    context.lineWidth = 2;
    context.strokeStyle = style.getPropertyValue("--line");
    if (scene.cells) {
      for (let x = 1; x < scene.size[0]; x++) line([x * unit, 0], [x * unit, canvas.height]);
      for (let y = 1; y < scene.size[1]; y++) line([0, y * unit], [canvas.width, y * unit]);
    }
    context.strokeStyle = ink;
    context.strokeRect(1, 1, canvas.width - 2, canvas.height - 2);
    context.lineWidth = 4;
    context.beginPath();
    path.slice(0, time + 1).map(at).forEach((point) => context.lineTo(...point));
    context.stroke();
    if (time > 0) {
      arrow(path[time - 1], outcomes[time - 1], "#cc79a7");
      arrow(path[time - 1], actions[time - 1], "#0072b2");
    }
    context.fillStyle = ink;
    context.beginPath();
    context.arc(...at(path[time]), 9, 0, 2 * Math.PI);
    context.fill();
  };

  const pause = () => {
    clearInterval(state.timer);
    state.timer = null;
    play.textContent = "Play";
  };

  const start = () => {
    if (state.time === Number(scrub.max)) show(0);
    play.textContent = "Pause";
    state.timer = setInterval(() => {
      if (state.time < Number(scrub.max)) show(state.time + 1);
      else pause();
    }, 250);
  };

  for (const of of [env, method, eta, seed, chance, episode, beside]) of.addEventListener("change", select);
  for (const [kind, of] of choice) {
    of.addEventListener("change", () => {
      const here = { world: env, method }[kind];
      here.value = of.value;
      if (here.value !== "") select();
      else here.selectedIndex = 0;
    });
  }
  scrub.addEventListener("input", () => { pause(); show(Number(scrub.value)); });
  play.addEventListener("click", () => (state.timer === null ? start() : pause()));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => show(state.time));
  select();
}
