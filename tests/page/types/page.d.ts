/** What the server makes, and what browsers have that TypeScript does not know. */
declare module "*/spec_schema.js" {
  export const SCHEMA: any;
}
declare module "*/report_pictures.js" {
  export const PICTURES: any;
}
interface Window {
  showSaveFilePicker?(options: { suggestedName: string }): Promise<any>;
}
interface MapConstructor {
  groupBy<K, T>(items: Iterable<T>, keyOf: (item: T) => K): Map<K, T[]>;
}
interface PerformanceEntry {
  type: string;
}
