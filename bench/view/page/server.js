// Questions to the server, and the numbers in its answers. A page that was sent has embedded.js in its place.

const TYPES = {float32: Float32Array, float16: Uint16Array, uint8: Uint8Array};

/**
 * Ask a route of the server (bench/view/server.py).
 * @param {string} route
 * @param {object} body
 * @returns {Promise<any>} facts; of an answer with numbers, its arrays by name are among them
 * @throws {Error} with the server's sentence
 */
export async function ask(route, body) {
  let response;
  try {
    response = await fetch(route, {
      method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(body),
    });
  } catch {
    throw new Error("bench view has ended: start it again and open the address that it prints.");
  }
  if (response.headers.get("Content-Type") !== "application/octet-stream") {
    const facts = await response.json();
    if (!response.ok) throw new Error(facts.error);
    return facts;
  }
  const data = await response.arrayBuffer();
  const length = new DataView(data).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  for (const [name, [offset, type, shape]] of Object.entries(facts.arrays)) {
    const count = shape.reduce((all, one) => all * one, 1);
    facts[name] = new TYPES[type](data, 4 + length + offset, count);
  }
  return facts;
}

/** What runs splats.js. */
export const worker = () => new Worker("splats.js", {type: "module"});
