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

// The player: replays the episodes stored in the page.
const data = document.getElementById("episodes");
if (data) {
  const { scenes, runs } = JSON.parse(data.textContent);
  const find = (id) => document.getElementById(id);
  const [env, method, eta, seed, chance, episode, scrub, play] =
    ["env", "method", "eta", "seed", "chance", "episode", "scrub", "play"].map(find);
  const canvas = find("scene");
  const context = canvas.getContext("2d");
  const state = { time: 0, timer: null, run: null, shown: null };
  const names = { nominal: "nominal chance", antagonist: "learned antagonist" };
  const distinct = (values) => [...new Set(values)];

  const fill = (select, options) => {
    const old = select.value;
    select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    if (options.some(([value]) => String(value) === old)) select.value = old;
  };

  const choose = () => {
    pause();
    fill(env, distinct(runs.map((run) => run.env)).map((name) => [name, name]));
    const ofEnv = runs.filter((run) => run.env === env.value);
    fill(method, distinct(ofEnv.map((run) => run.method ?? "")).map((name) => [name, name]));
    const ofMethod = ofEnv.filter((run) => (run.method ?? "") === method.value);
    fill(eta, distinct(ofMethod.map((run) => run.eta)).map((value) => [value, value]));
    const ofEta = ofMethod.filter((run) => String(run.eta) === eta.value);
    fill(seed, ofEta.map((run) => [run.seed, run.seed]));
    state.run = ofEta.find((run) => String(run.seed) === seed.value);
    fill(chance, distinct(state.run.stored.map((of) => of.chance)).map((kind) => [kind, names[kind]]));
    const stored = state.run.stored.map((of, place) => [of, place])
      .filter(([of]) => of.chance === chance.value);
    fill(episode, stored.map(([of, place]) =>
      [place, `${of.index}: ${of.end} after ${of.actions.length} steps`]));
    state.shown = state.run.stored[Number(episode.value)];
    scrub.max = state.shown.actions.length;
    show(0);
  };

  const show = (time) => {
    state.time = time;
    scrub.value = time;
    draw();
    const { actions, ratios, budgets, value, end } = state.shown;
    const number = (x) => (x >= 100 ? x.toFixed(0) : x.toPrecision(3));
    const product = ratios.slice(0, time).reduce((a, b) => a * b, 1);
    const lines = [`step ${time} of ${actions.length}`, `remaining budget ${number(budgets[time])}`];
    if (time > 0) {
      lines.push(`likelihood ratio of the last outcome ${number(ratios[time - 1])}`);
      lines.push(`product so far ${number(product)}`);
    }
    if (time === actions.length) lines.push(`ended: ${end}, return ${value.toFixed(3)}`);
    find("step").textContent = lines.join(" · ");
  };

  const draw = () => {
    const scene = scenes[state.run.scene];
    const style = getComputedStyle(document.documentElement);
    const ink = style.getPropertyValue("--ink");
    const unit = canvas.width / scene.size[0];
    canvas.height = Math.round(unit * scene.size[1]);
    // A cell's place is its corner, a body's its centre.
    const offset = scene.cells ? 0.5 : 0;
    const at = ([x, y]) => [(x + offset) * unit, (y + offset) * unit];
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
    const { path, actions, outcomes } = state.shown;
    context.lineWidth = 4;
    context.beginPath();
    path.slice(0, state.time + 1).map(at).forEach((point) => context.lineTo(...point));
    context.stroke();
    if (state.time > 0) {
      const from = path[state.time - 1];
      arrow(from, outcomes[state.time - 1], "#cc79a7", scene, at);
      arrow(from, actions[state.time - 1], "#0072b2", scene, at);
    }
    context.fillStyle = ink;
    context.beginPath();
    context.arc(...at(path[state.time]), 9, 0, 2 * Math.PI);
    context.fill();
  };

  const line = (from, to) => {
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
  };

  const arrow = (from, [dx, dy], colour, scene, at) => {
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
    context.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--ink");
  };

  const pause = () => {
    clearInterval(state.timer);
    state.timer = null;
    play.textContent = "Play";
  };

  const start = () => {
    if (state.time === state.shown.actions.length) show(0);
    play.textContent = "Pause";
    state.timer = setInterval(() => {
      if (state.time < state.shown.actions.length) show(state.time + 1);
      else pause();
    }, 250);
  };

  for (const select of [env, method, eta, seed, chance, episode]) select.addEventListener("change", choose);
  scrub.addEventListener("input", () => { pause(); show(Number(scrub.value)); });
  play.addEventListener("click", () => (state.timer === null ? start() : pause()));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  choose();
}
