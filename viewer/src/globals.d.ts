declare module '*.wasm' {
  const bytes: Uint8Array
  export default bytes
}

declare module 'worker:*' {
  const code: string
  export default code
}

declare module '*/laz-perf.js' {
  const create: (settings: { wasmBinary: Uint8Array }) => Promise<any>
  export default create
}

declare module '*.css'
