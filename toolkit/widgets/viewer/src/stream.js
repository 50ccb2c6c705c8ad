import { Stage } from "./stage.js";

// Milliseconds between two questions for a picture.
const PACE = 40;

// Pictures come from the server; the browser only says from where.
export function render({ model, el }) {
  const surface = document.createElement("canvas");
  const context = surface.getContext("2d");
  let wanted = null, waiting = 0, number = 0;

  const ask = () => {
    waiting = 0;
    number += 1;
    model.send_msg({ kind: "view", number, ...wanted });
  };
  const stage = new Stage(el, model, surface, () => {
    wanted = stage.standing();
    if (!waiting) waiting = setTimeout(ask, PACE);
  });
  stage.gone.signal.addEventListener("abort", () => clearTimeout(waiting));
  model.on("msg:custom", async (message) => {
    if (message.kind !== "picture") return;
    const picture = await createImageBitmap(new Blob([message.data]));
    [surface.width, surface.height] = [picture.width, picture.height];
    context.drawImage(picture, 0, 0);
    picture.close();
    stage.tell();
    surface.dataset.shown = message.whole ? "whole" : "coarse";
    surface.dataset.number = message.number;
    model.send_msg({ kind: "shown", number: message.number });
  });
  const open = () => stage.tell(model.scene.cameras ? "The server draws the first picture …" : "");
  model.on("scene", open);
  stage.open();
  open();
}
