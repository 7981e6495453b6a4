// The label image of one frame: class ids, the strokes that change them, and the picture of them.

const MOST_UNDO = 100;

export class Strokes {
  // width, height: of the frame. ids: Uint8Array, row by row. colors: [r, g, b] by id. ignore: id of what is not painted.
  constructor(canvas, width, height, ids, colors, ignore) {
    Object.assign(this, { width, height, ids, colors, ignore });
    canvas.width = width;
    canvas.height = height;
    this.context = canvas.getContext("2d");
    this.undone = [];
    this.before = null;
    this.draw({ x0: 0, y0: 0, x1: width, y1: height });
  }

  get undoable() { return this.undone.length > 0; }

  begin() {
    this.before = this.ids.slice();
    this.box = { x0: this.width, y0: this.height, x1: 0, y1: 0 };
  }

  // Paint a line of discs; places are in pixels of the frame.
  line(x0, y0, x1, y1, size, id) {
    const radius = size / 2, steps = Math.max(1, Math.ceil(Math.hypot(x1 - x0, y1 - y0) / Math.max(radius / 2, 0.5)));
    for (let i = 0; i <= steps; i++) this.disc(x0 + (x1 - x0) * i / steps, y0 + (y1 - y0) * i / steps, radius, id);
    const pad = Math.ceil(radius) + 1;
    this.draw(this.clip(Math.min(x0, x1) - pad, Math.min(y0, y1) - pad, Math.max(x0, x1) + pad, Math.max(y0, y1) + pad));
  }

  disc(x, y, radius, id) {
    const box = this.clip(x - radius, y - radius, x + radius + 1, y + radius + 1);
    const inside = Math.max(radius * radius, 0.5);
    for (let v = box.y0; v < box.y1; v++) {
      for (let u = box.x0; u < box.x1; u++) {
        if ((u + 0.5 - x) ** 2 + (v + 0.5 - y) ** 2 <= inside) this.ids[v * this.width + u] = id;
      }
    }
    this.box.x0 = Math.min(this.box.x0, box.x0);
    this.box.y0 = Math.min(this.box.y0, box.y0);
    this.box.x1 = Math.max(this.box.x1, box.x1);
    this.box.y1 = Math.max(this.box.y1, box.y1);
  }

  // The stroke is whole: true where it changed something.
  end() {
    const box = this.box, changed = this.patch(this.ids, box), was = this.patch(this.before, box);
    this.before = null;
    if (!changed.some((id, i) => id !== was[i])) return false;
    this.undone.push({ box, was });
    if (this.undone.length > MOST_UNDO) this.undone.shift();
    return true;
  }

  undo() {
    const last = this.undone.pop();
    if (!last) return false;
    const { box, was } = last, width = box.x1 - box.x0;
    for (let v = box.y0; v < box.y1; v++) {
      this.ids.set(was.subarray((v - box.y0) * width, (v - box.y0 + 1) * width), v * this.width + box.x0);
    }
    this.draw(box);
    return true;
  }

  patch(ids, box) {
    const width = Math.max(box.x1 - box.x0, 0), found = new Uint8Array(width * Math.max(box.y1 - box.y0, 0));
    for (let v = box.y0; v < box.y1; v++) {
      found.set(ids.subarray(v * this.width + box.x0, v * this.width + box.x1), (v - box.y0) * width);
    }
    return found;
  }

  clip(x0, y0, x1, y1) {
    return {
      x0: Math.max(0, Math.floor(x0)), y0: Math.max(0, Math.floor(y0)),
      x1: Math.min(this.width, Math.ceil(x1)), y1: Math.min(this.height, Math.ceil(y1)),
    };
  }

  draw(box) {
    const width = box.x1 - box.x0, height = box.y1 - box.y0;
    if (width <= 0 || height <= 0) return;
    const picture = this.context.createImageData(width, height), data = picture.data;
    const ids = this.patch(this.ids, box);
    for (let i = 0; i < ids.length; i++) {
      if (ids[i] === this.ignore) continue;
      const [r, g, b] = this.colors[ids[i]];
      data[4 * i] = r; data[4 * i + 1] = g; data[4 * i + 2] = b; data[4 * i + 3] = 255;
    }
    this.context.putImageData(picture, box.x0, box.y0);
  }
}
