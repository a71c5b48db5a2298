// Why a control cannot work now: a key of the language files and its values, for each control that is barred.

const POWERED = ["holding", "moving", "stopping"];

// For `robot` and `state` as the page knows them, null without contact; `choice` is what the operator has chosen:
// file ("none", "checking", "barred" or ""), name of a pose, and the names of the poses that there are and are taught.
export function barriers(robot, state, choice) {
  if (!robot || !state) return new Proxy({}, { get: () => ["bar.contact"] });
  const { mode, goal, lease } = state;
  const mine = lease === robot.user;
  const others = lease && !mine ? ["bar.leased", { user: lease }] : null;
  const leased = others ?? (robot.lease === "required" && !lease ? ["bar.lease_required"] : null);
  const running = mode !== "disabled" && mode !== "fault";
  const unpowered = running ? null : ["bar.unpowered"];
  const known = choice.names.includes(choice.name);
  const taught = choice.taught.includes(choice.name);
  const bars = {
    enable: mode === "disabled" ? null : [mode === "fault" ? "bar.fault" : "bar.powered"],
    disable: unpowered,
    quick_stop: unpowered,
    home: mode === "holding" && !goal ? null : [`bar.${mode === "holding" ? "moving" : mode}`],
    reset: mode === "fault" ? null : ["bar.no_fault"],
    pause: mode === "moving" ? null : ["bar.at_rest"],
    resume: goal && (mode === "holding" || mode === "stopping") ? null : ["bar.not_paused"],
    acquire: others ?? (mine ? ["bar.lease_mine"] : null),
    takeover: others ? null : [mine ? "bar.lease_mine" : "bar.lease_free"],
    release: mine ? null : ["bar.lease_not_mine"],
    // After a stop the service refuses goals until the robot stands; a jog that brakes may be followed by another.
    goal: !robot.permissions.includes("goal") ? ["bar.role"] : POWERED.includes(mode) && (mode !== "stopping" || goal) ? null : [`bar.${mode}`],
    override: null,
    set_output: robot.permissions.includes("set_output") ? null : ["bar.role"],
    teach: !choice.name ? ["bar.name"] : known && !taught ? ["bar.configured", { name: choice.name }]
      : mode === "holding" || mode === "disabled" ? null : [`bar.${mode}`],
    forget: !choice.name ? ["bar.name"] : taught ? null : ["bar.not_taught", { name: choice.name }],
  };
  bars.follow = bars.goal ?? (choice.file ? [`bar.file_${choice.file}`] : null);
  for (const name of [...Object.keys(bars)])
    if (!robot.ignores_lease.includes(name) && !["takeover", "teach", "forget"].includes(name)) bars[name] = leased ?? bars[name];
  return bars;
}
