/** Colour scales that the colour-blind can read, and grey. The anchors are matplotlib's (CC0), equally spaced. */

const ANCHORS: Record<string, string> = {
  viridis:
    '440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c 1fa088 28ae80 3fbc73 5ec962 84d44b addc30 d8e219 fde725',
  cividis:
    '00224e 002e6a 1a386f 32436d 434e6c 535a6d 61656f 6f7073 7d7c78 8c8878 9b9476 aba072 bcae6c cdbb63 dec958 f0d846 fee838',
  magma:
    '000004 0a0822 1d1147 36106b 51127c 6a1c81 832681 9c2e7f b73779 d0416f e75263 f56b5c fc8961 fea772 fec488 fde2a3 fcfdbf',
  grey: '000000 ffffff',
}

export const SCALE_NAMES = Object.keys(ANCHORS)

const made = new Map<string, Uint8Array>()

/** 256 colours as RGB bytes; an unknown name gives viridis. */
export function scale(name: string): Uint8Array {
  const known = name in ANCHORS ? name : 'viridis'
  let colours = made.get(known)
  if (!colours) made.set(known, (colours = interpolated(ANCHORS[known]!.split(' '))))
  return colours
}

function interpolated(anchors: string[]): Uint8Array {
  const colours = new Uint8Array(256 * 3)
  for (let index = 0; index < 256; index++) {
    const at = (index / 255) * (anchors.length - 1)
    const low = Math.min(Math.floor(at), anchors.length - 2)
    const [a, b] = [rgb(anchors[low]!), rgb(anchors[low + 1]!)]
    for (let band = 0; band < 3; band++) {
      colours[index * 3 + band] = Math.round(a[band]! + (b[band]! - a[band]!) * (at - low))
    }
  }
  return colours
}

/** Red, green, blue (0 to 255) of `#rrggbb` or `rrggbb`; grey where it is something else. */
export function rgb(hex: string): [number, number, number] {
  const match = /^#?([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})$/i.exec(hex)
  return match ? [parseInt(match[1]!, 16), parseInt(match[2]!, 16), parseInt(match[3]!, 16)] : [158, 158, 158]
}

/** `rgba(…)` of a hexadecimal colour: what a document says becomes numbers first, so no text of it reaches a style. */
export function css(hex: string, opacity = 1): string {
  return `rgba(${rgb(hex).join(', ')}, ${opacity})`
}

/** A picture of a scale, for legends. */
export function ramp(name: string, width = 128, height = 8): HTMLCanvasElement {
  const canvas = document.createElement('canvas')
  ;[canvas.width, canvas.height] = [width, height]
  const context = canvas.getContext('2d')!
  const colours = scale(name)
  for (let x = 0; x < width; x++) {
    const at = Math.round((x / (width - 1)) * 255) * 3
    context.fillStyle = `rgb(${colours[at]}, ${colours[at + 1]}, ${colours[at + 2]})`
    context.fillRect(x, 0, 1, height)
  }
  return canvas
}
