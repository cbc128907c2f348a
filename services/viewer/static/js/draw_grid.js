// A ROS map as a world: its free and its occupied cells, each as a picture of a pixel a cell.

const FREE = 0, OCCUPIED = 100;
let kept = { cells: "", values: null, pictures: new Map() }; // of the map that was drawn last

/** Base64 of zlib of a byte a cell, row by row from the lower left. */
async function unpack(cells) {
  const packed = Uint8Array.from(atob(cells), (letter) => letter.charCodeAt(0));
  const plain = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(plain).arrayBuffer());
}

/** The cells of one value in one colour, or null until they are there; `ready` is called then. */
function picture(grid, value, colour, ready) {
  if (kept.cells !== grid.cells) {
    const fresh = { cells: grid.cells, values: null, pictures: new Map() };
    kept = fresh;
    unpack(grid.cells).then((values) => {
      fresh.values = values;
      ready();
    });
  }
  if (!kept.values) return null;
  const key = `${value} ${colour}`;
  if (!kept.pictures.has(key)) {
    if (kept.pictures.size > 8) kept.pictures.clear();
    kept.pictures.set(key, painted(grid, kept.values, value, colour));
  }
  return kept.pictures.get(key);
}

function painted(grid, values, value, colour) {
  const canvas = new OffscreenCanvas(grid.width, grid.height), ctx = canvas.getContext("2d");
  const image = ctx.createImageData(grid.width, grid.height);
  for (let i = 0; i < values.length; i++) if (values[i] === value) image.data[4 * i + 3] = 255;
  ctx.putImageData(image, 0, 0);
  ctx.globalCompositeOperation = "source-in";
  ctx.fillStyle = colour;
  ctx.fillRect(0, 0, grid.width, grid.height);
  return canvas;
}

function draw(ctx, camera, grid, value, colour, ready) {
  const shown = picture(grid, value, colour, ready);
  if (!shown) return;
  const [x, y, yaw] = grid.origin, size = grid.resolution * camera.scale; // pixels a cell
  const along = Math.cos(yaw) * size, across = Math.sin(yaw) * size;
  ctx.save();
  ctx.transform(along, -across, -across, -along, ...camera.toScreen(x, y));
  ctx.imageSmoothingEnabled = size < 1.5; // else walls of one cell would come and go
  ctx.drawImage(shown, 0, 0);
  ctx.restore();
}

export const drawFreeCells = (ctx, camera, grid, colours, ready) => draw(ctx, camera, grid, FREE, colours.free, ready);
export const drawOccupiedCells = (ctx, camera, grid, colours, ready) => draw(ctx, camera, grid, OCCUPIED, colours.wall, ready);
