// Draws the free and the occupied cells of a ROS map, each as an image with one pixel per cell.

const FREE = 0, OCCUPIED = 100;
let decoding = ""; // the cells that are being decoded, or were last
let cache = { values: null, images: new Map() }; // of the map that is shown, which stays until the next one is decoded

/** Decodes cells: base64 of zlib of one byte per cell, row by row from the lower left. */
async function unpack(cells) {
  const packed = Uint8Array.from(atob(cells), (letter) => letter.charCodeAt(0));
  const plain = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(plain).arrayBuffer());
}

/** Image of the cells of one value in one colour; null until they are decoded, after which `ready` is called. */
function imageOf(grid, value, colour, ready) {
  if (decoding !== grid.cells) {
    decoding = grid.cells;
    unpack(grid.cells).then((values) => {
      if (decoding !== grid.cells) return; // a newer map has come
      cache = { grid, values, images: new Map() };
      ready();
    });
  }
  if (!cache.values) return null;
  const key = `${value} ${colour}`;
  if (!cache.images.has(key)) {
    if (cache.images.size > 8) cache.images.clear();
    cache.images.set(key, painted(cache.grid, cache.values, value, colour));
  }
  return cache.images.get(key);
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
  const shown = imageOf(grid, value, colour, ready);
  if (!shown) return;
  const { origin: [x, y, yaw], resolution } = cache.grid, size = resolution * camera.scale; // pixels per cell
  const along = Math.cos(yaw) * size, across = Math.sin(yaw) * size;
  ctx.save();
  ctx.transform(along, -across, -across, -along, ...camera.toScreen(x, y));
  ctx.imageSmoothingEnabled = size < 1.5; // otherwise walls of one cell would flicker
  ctx.drawImage(shown, 0, 0);
  ctx.restore();
}

export const drawFreeCells = (ctx, camera, grid, colours, ready) => draw(ctx, camera, grid, FREE, colours.free, ready);
export const drawOccupiedCells = (ctx, camera, grid, colours, ready) => draw(ctx, camera, grid, OCCUPIED, colours.wall, ready);
