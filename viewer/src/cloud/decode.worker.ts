/** Decodes the points of one node of a COPC file. Runs in a worker; gets bytes, answers with arrays. */

import createLazPerf from '../../node_modules/laz-perf/lib/worker/laz-perf.js'
import wasmBinary from '../../node_modules/laz-perf/lib/worker/laz-perf.wasm'

export interface DecodeTask {
  id: number
  bytes: Uint8Array<ArrayBuffer>
  count: number
  format: number
  recordBytes: number
  /** Coordinate = number · scale + offset, in metres of the map. */
  scale: [number, number, number]
  offset: [number, number, number]
  /** What positions count from (m). */
  origin: [number, number, number]
  /** Middle of the node's cube (m): it parts the points by the child that lies where they are. */
  middle: [number, number, number]
}

export interface Decoded {
  count: number
  /** Whole numbers of the file, three a point. */
  raw: Int32Array<ArrayBuffer>
  /** Metres from the node's origin, three a point. */
  position: Float32Array<ArrayBuffer>
  intensity: Uint16Array<ArrayBuffer>
  classes: Uint8Array<ArrayBuffer>
  pass: Uint16Array<ArrayBuffer>
  /** Which of the eight children lies there: x, y and z beyond the middle count 1, 2 and 4. */
  octant: Uint8Array<ArrayBuffer>
  rgb: Uint8Array<ArrayBuffer> | null
}

let module: Promise<any> | null = null

async function decode(task: DecodeTask): Promise<Decoded> {
  module ??= createLazPerf({ wasmBinary })
  const perf = await module
  const { bytes, count, format, recordBytes } = task
  const compressed = perf._malloc(bytes.byteLength)
  const record = perf._malloc(recordBytes)
  const decoder = new perf.ChunkDecoder()
  const decoded: Decoded = {
    count,
    raw: new Int32Array(count * 3),
    position: new Float32Array(count * 3),
    intensity: new Uint16Array(count),
    classes: new Uint8Array(count),
    pass: new Uint16Array(count),
    octant: new Uint8Array(count),
    rgb: format === 7 || format === 8 ? new Uint8Array(count * 3) : null,
  }
  try {
    perf.HEAPU8.set(bytes, compressed)
    decoder.open(format, recordBytes, compressed)
    let view = new DataView(perf.HEAPU8.buffer, record, recordBytes)
    for (let index = 0; index < count; index++) {
      decoder.getPoint(record)
      if (view.buffer !== perf.HEAPU8.buffer) view = new DataView(perf.HEAPU8.buffer, record, recordBytes)
      read(view, index, decoded, task)
    }
  } finally {
    perf._free(compressed)
    perf._free(record)
    decoder.delete()
  }
  return decoded
}

/** One record of the point formats 6 to 8 (LAS 1.4 R15, table 10). */
function read(view: DataView, index: number, into: Decoded, { scale, offset, origin, middle }: DecodeTask): void {
  const at = index * 3
  let octant = 0
  for (let axis = 0; axis < 3; axis++) {
    const number = view.getInt32(axis * 4, true)
    into.raw[at + axis] = number
    const position = number * scale[axis]! + (offset[axis]! - origin[axis]!)
    into.position[at + axis] = position
    if (position >= middle[axis]! - origin[axis]!) octant |= 1 << axis
  }
  into.octant[index] = octant
  into.intensity[index] = view.getUint16(12, true)
  into.classes[index] = view.getUint8(16)
  into.pass[index] = view.getUint16(20, true)
  if (into.rgb) for (let band = 0; band < 3; band++) into.rgb[at + band] = view.getUint16(30 + 2 * band, true) >> 8
}

self.onmessage = async ({ data }: MessageEvent<DecodeTask>) => {
  try {
    const decoded = await decode(data)
    const buffers = [decoded.raw, decoded.position, decoded.intensity, decoded.classes, decoded.pass, decoded.octant, decoded.rgb]
    self.postMessage(
      { id: data.id, decoded },
      { transfer: buffers.filter((one) => one !== null).map((one) => one.buffer) },
    )
  } catch (error) {
    self.postMessage({ id: data.id, wrong: String(error) })
  }
}
